import inspect
import random
import re
import sys
from functools import partial
from pathlib import Path
from types import ModuleType

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from gymnasium.wrappers import FrameStackObservation, TimeLimit, TransformObservation

from environments import broken_environments
from environments.broken_environments import (
    BrokenClose,
    Cart,
    Crash,
    DeadNumber,
    EndlessIfStill,
    FloatForWhole,
    FourValues,
    HiddenGoal,
    LimitAsTermination,
    Masked,
    NoSpace,
    OutOfBounds,
    RewardArray,
    SameActions,
    TextObservation,
    UnseededWind,
)
from thorndike.api.checking import check_env
from thorndike.environments.checker import CHECKS, check
from thorndike.environments.checking.findings import SEVERITIES, Findings
from thorndike.environments.checking.hidden_state import is_random
from thorndike.environments.checking.play import Player
from thorndike.environments.origins import make_single
from thorndike.errors import UserError

STEPS = 300
BROKEN = [kind for _, kind in inspect.getmembers(broken_environments, inspect.isclass) if hasattr(kind, "kind")]
HEALTHY = [
    "CartPole-v1",
    "Pendulum-v1",
    "FrozenLake-v1",
    "Blackjack-v1",
    "Taxi-v4",
    "MountainCar-v0",
    "CliffWalking-v1",
    "LunarLander-v3",
]
RIGHT_OF_HEALTHY = {"CliffWalking-v1": {"never_ends"}}


PAGE = Path(__file__).parents[2] / "docs" / "check_env.md"


def kinds_of(findings, *severities):
    return {finding.kind for finding in findings if finding.severity in (severities or SEVERITIES)}


def test_more_than_twelve_kinds_of_mistake_are_tried():
    assert len({broken.kind for broken in BROKEN}) > 40


def test_the_page_of_docs_has_every_kind_and_its_severity():
    told = dict(re.findall(r"^\| `(\w+)` \| (\w+) \|", PAGE.read_text(encoding="utf-8"), re.MULTILINE))
    assert set(told) == {broken.kind for broken in BROKEN} | {"single_instance"}
    assert set(told.values()) == set(SEVERITIES)


@pytest.mark.parametrize("broken", BROKEN, ids=lambda broken: broken.__name__)
def test_a_broken_environment_is_told_by_its_kind_and_nothing_else_is_said(broken):
    random.seed(5)
    np.random.seed(5)
    findings = check(broken, STEPS).findings
    assert kinds_of(findings) == {broken.kind}
    assert f"| `{broken.kind}` | {findings[0].severity} |" in PAGE.read_text(encoding="utf-8")
    for finding in findings:
        assert finding.message
        assert finding.fix
        assert "\n" not in finding.message + finding.fix


@pytest.mark.parametrize("healthy", [Cart, Masked], ids=lambda healthy: healthy.__name__)
def test_a_healthy_environment_has_no_findings_and_everything_is_checked(healthy):
    report = check(healthy, STEPS)
    assert report.findings == []
    assert report.checked == list(CHECKS)
    assert report.not_checked == []
    assert report.steps == STEPS
    assert report.episodes > 5


@pytest.mark.parametrize("id", HEALTHY)
def test_gymnasiums_environments_have_no_errors_and_no_wrong_warnings(id):
    assert kinds_of(check(partial(make_single, id, {})).findings, "error", "warning") == RIGHT_OF_HEALTHY.get(id, set())


def test_what_an_error_makes_pointless_is_not_looked_at():
    report = check(NoSpace)
    assert report.checked == ["spaces", "closing"]
    assert set(report.not_checked) == set(CHECKS) - {"spaces", "closing"}
    report = check(UnseededWind, STEPS)
    assert "hidden state" in report.not_checked
    assert "ends and time limits" in report.checked


def test_a_crash_is_told_with_its_line_and_action_and_what_came_before_is_judged():
    (finding,) = check(Crash, STEPS).findings
    lines, first = inspect.getsourcelines(Crash)
    number = first + next(i for i, line in enumerate(lines) if "the line that breaks" in line)
    assert finding.message.startswith("step 8 after reset(seed=0), action ")
    assert f"broken_environments.py, line {number}: return [][action]" in finding.message
    assert "IndexError: list index out of range" in finding.message


def test_a_crash_of_a_class_without_a_file_is_told_too():
    module = ModuleType("typed_in_a_terminal")
    sys.modules[module.__name__] = module
    source = "from environments.broken_environments import Cart\nclass Typed(Cart):\n    def reward(self):\n        return 1 / 0\n"
    exec(compile(source, "<terminal>", "exec"), vars(module))
    assert "ZeroDivisionError: division by zero" in check(module.Typed, STEPS).findings[0].message
    del sys.modules[module.__name__]


def test_a_constructor_that_raises_the_first_time_is_the_users_mistake():
    with pytest.raises(UserError, match="cannot be made with no settings: ZeroDivisionError"):
        check_env(lambda: 1 / 0)


def test_leaves_of_dict_and_tuple_are_named_by_their_path():
    assert "observation['cell'] is float64" in check(FloatForWhole, STEPS).findings[0].message
    message = check(OutOfBounds, STEPS).findings[0].message
    assert "observation[0][0] is -0.67" in message
    assert "-0.6" in message
    assert " times)" in message


def test_what_is_found_again_is_counted_once_a_recorded_step():
    assert check(RewardArray, STEPS).findings[0].message.endswith(f"(seen {STEPS} times)")


def test_old_step_values_are_told_through_gymnasiums_time_limit():
    (finding,) = check(lambda: TimeLimit(FourValues(), 30), STEPS).findings
    assert (finding.kind, finding.severity) == ("step_return", "error")


def test_bounds_that_an_environment_of_gymnasium_is_known_to_leave_are_a_hint():
    class Known(OutOfBounds):
        spec = EnvSpec("LunarLander-v3", max_episode_steps=60)

    assert [(finding.kind, finding.severity) for finding in check(Known, STEPS).findings] == [("observation_bounds", "hint")]


def test_unknown_leaves_are_left_out_and_the_others_checked():
    class WithText(DeadNumber):
        observation_space = spaces.Dict({"numbers": DeadNumber.observation_space, "text": TextObservation.observation_space})

        def look(self):
            return {"numbers": super().look(), "text": "left"}

    findings = check(WithText, STEPS).findings
    assert kinds_of(findings) == {"unsupported_space", "observation_constant"}
    assert "observation_space['text'] is Text" in findings[0].message
    assert "observation['numbers']: dimension 2 never changed" in findings[1].message


def test_a_second_environment_that_cannot_be_made_is_a_hint():
    made = []

    def only_one():
        if made:
            raise UserError("the port is taken")
        made.append(True)
        return Cart()

    (finding,) = check(only_one, STEPS).findings
    assert (finding.kind, finding.severity) == ("single_instance", "hint")


def test_a_time_limit_from_outside_mends_an_endless_game():
    assert kinds_of(check(EndlessIfStill, STEPS).findings) == {"no_time_limit"}
    assert check_env(EndlessIfStill, steps=STEPS, max_episode_steps=50) == []


def test_the_hidden_speed_of_a_cart_pole_is_told_and_two_frames_show_it():
    def without_speeds():
        seen = spaces.Box(-5, 5, (2,), np.float32)
        return TransformObservation(gymnasium.make("CartPole-v1"), lambda observation: observation[[0, 2]], seen)

    (finding,) = check(without_speeds).findings
    assert finding.kind == "hidden_state"
    assert "observation[0]" in finding.message
    assert check(lambda: FrameStackObservation(without_speeds(), 2)).findings == []


def test_chance_is_no_hidden_state():
    class Gusts(Cart):
        observation_space = spaces.Discrete(5)

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            return 2, {}

        def step(self, action):
            super().step(action)
            return int(self.np_random.integers(5)), float(self.np_random.random() + action), False, self.steps > 20, {}

    assert check(Gusts, STEPS).findings == []
    assert is_random(Player(Gusts(), Findings()), seed=0)
    assert not is_random(Player(HiddenGoal(), Findings()), seed=0)


def test_chance_in_a_part_or_in_a_wrapper_is_seen():
    class Wind:
        def __init__(self):
            self.generator = random.Random(0)

    class Outdoors(Cart):
        def reset(self, *, seed=None, options=None):
            self.wind = Wind()
            return super().reset(seed=seed)

        def step(self, action):
            self.place += self.wind.generator.random() / 100
            return super().step(action)

    assert is_random(Player(Outdoors(), Findings()), seed=0)
    assert is_random(Player(gymnasium.make("FrozenLake-v1"), Findings()), seed=0)
    assert not is_random(Player(gymnasium.make("CartPole-v1"), Findings()), seed=0)


def test_only_the_actions_that_are_the_same_are_named():
    (finding,) = check(SameActions, STEPS).findings
    assert finding.message.startswith("actions 1, 2 did the same at ")
    assert finding.severity == "hint"


def test_masked_actions_are_never_played_and_never_compared():
    class NeverBoth(Cart):
        """In each state one of actions 1 and 2, which do the same, is forbidden."""

        def mask(self):
            return np.array([True, self.steps % 2 == 0, self.steps % 2 == 1])

        def reset(self, *, seed=None, options=None):
            return super().reset(seed=seed)[0], {"action_mask": self.mask()}

        def step(self, action):
            assert self.mask()[action]
            return (*super().step(min(int(action), 1))[:4], {"action_mask": self.mask()})

    assert check(NeverBoth, STEPS).findings == []


@pytest.mark.parametrize(
    ("space", "mask"),
    [
        (spaces.MultiDiscrete([3, 2]), np.array([1, 1, 0, 1, 1], np.int8)),
        (spaces.MultiDiscrete([3, 2]), (np.array([1, 1, 0]), np.array([1, 1]))),
        (spaces.MultiBinary(2), np.array([1, 0, 1, 1], bool)),
    ],
    ids=["row", "tuple", "binary"],
)
def test_masks_of_several_dimensions_are_kept(space, mask):
    class Buttons(Cart):
        action_space = space

        def action_masks(self):
            return mask

        def step(self, action):
            assert action[0] < (2 if len(mask) != 4 else 1)
            return super().step(action[0] + action[1])

    assert check(Buttons, STEPS).findings == []


def test_a_natural_length_below_ten_is_a_hint_and_a_limit_a_warning():
    class Short(LimitAsTermination):
        limit = 4

    assert [finding.severity for finding in check(LimitAsTermination, STEPS).findings] == ["warning"]
    assert ("time_limit_as_termination", "hint") in [(finding.kind, finding.severity) for finding in check(Short, STEPS).findings]


def test_one_step_episodes_are_in_order():
    class Bandit(Cart):
        def step(self, action):
            return super().step(action)[0], float(self.np_random.normal(int(action))), True, False, {}

    assert check(Bandit, STEPS).findings == []


def test_the_same_seed_gives_the_same_report():
    assert check(LimitAsTermination, STEPS, seed=3) == check(LimitAsTermination, STEPS, seed=3)


def test_the_users_object_is_never_stepped_or_closed():
    own = BrokenClose()
    own.reset(seed=0)
    before = dict(vars(own))
    assert kinds_of(check_env(own, steps=100)) >= {"close"}
    assert {name: value for name, value in vars(own).items() if name != "_np_random"} == {
        name: value for name, value in before.items() if name != "_np_random"
    }


@pytest.mark.parametrize(("steps", "seed"), [(0, 0), (10, -1)])
def test_steps_and_seed_that_make_no_sense_are_refused(steps, seed):
    with pytest.raises(UserError, match="at least 1 step and a seed of at least 0"):
        check_env(Cart, steps=steps, seed=seed)


def test_an_environment_that_is_compiled_alone_is_checked_too():
    assert kinds_of(check_env("probe/ActionChoice-v0", steps=20), "error", "warning") == set()
