"""Which learners' values can be held against the environment's rewards, and what is said of the others."""

import pytest

from thorndike.api.value_scale import incomparable_values


@pytest.mark.parametrize(
    ("wrappers", "config", "told"),
    [
        ([], {"gamma": 0.99}, None),
        ([{"name": "normalize_observation"}, {"name": "frame_stack", "k": 4}], {"gamma": 1, "baseline": True, "munchausen": False}, None),
        ([{"name": "normalize_observation"}, {"name": "normalize_reward"}], {"gamma": 0.99}, "normalize_reward"),
        ([{}], {"gamma": 0.99}, "one of your own"),
        ([], {"gamma": 0.99, "munchausen": True}, "munchausen"),
        ([], {"gamma": 0.99, "baseline": False}, "baseline=false"),
        ([], {}, "no discounted values"),
    ],
)
def test_what_is_on_another_scale_is_said_in_one_line(wrappers, config, told):
    found = incomparable_values({"wrappers": wrappers, "config": config})
    assert found == told if told is None else told in found and "\n" not in found
