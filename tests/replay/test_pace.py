import pytest

from thorndike.errors import UserError
from thorndike.replay.pace import Pace, pace


def test_settings_count_the_steps_of_all_environments():
    assert pace("sac", 1000, 100, 8, 4, num_envs=4) == Pace(rollout_length=2, gradient_steps=4, ring_steps=250, warmup_iterations=13)
    assert pace("sac", 1000, 100, 1, 1, num_envs=1) == Pace(1, 1, 1000, 100)


def test_minus_one_gradient_step_is_one_an_environment_step():
    assert pace("sac", 1000, 0, 8, -1, num_envs=4).gradient_steps == 8
    assert pace("sac", 1000, 0, 1, -1, num_envs=4).gradient_steps == 4


def test_the_warm_up_lasts_until_a_sample_is_there():
    assert pace("sac", 1000, 0, 1, 1, num_envs=1).warmup_iterations == 2
    assert pace("sac", 1000, 0, 1, 1, num_envs=1, follow=5).warmup_iterations == 6


@pytest.mark.parametrize(("buffer", "updates", "message"), [(1, 1, "make it larger"), (100, 0, "at least 1, or -1")])
def test_what_does_not_fit_is_refused_with_its_numbers(buffer, updates, message):
    with pytest.raises(UserError, match=message):
        pace("sac", buffer, 0, 1, updates, num_envs=1)
