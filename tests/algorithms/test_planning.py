import gymnasium
import numpy as np
import pytest

from thorndike.algorithms.planning import (
    Config,
    action_values,
    finite_horizon,
    plan,
    policy_evaluation,
    policy_iteration,
    value_iteration,
)
from thorndike.environments.native.blackjack_table import blackjack_table
from thorndike.environments.native.table import Table, read_table
from thorndike.errors import UserError

OPTIMA = [
    ("FrozenLake-v1", {}, {0.9: 0.068890905, 0.99: 0.542025932, 0.999: 0.785533257, 1.0: 14 / 17}),
    ("FrozenLake8x8-v1", {}, {0.9: 0.006411114, 0.99: 0.414640362, 0.999: 0.892635495, 1.0: 1.0}),
    ("FrozenLake-v1", {"is_slippery": False}, {0.99: 0.99**5}),
    ("CliffWalking-v1", {}, {0.9: -10 * (1 - 0.9**13), 0.99: -100 * (1 - 0.99**13), 1.0: -13.0}),
    ("CliffWalkingSlippery-v1", {}, {0.9: -9.936417277, 0.99: -46.352672182, 1.0: -64.709175910}),
    ("Taxi-v4", {}, {0.9: -1.263323099, 0.99: 6.327464315, 0.999: 7.759898116, 1.0: 7.93}),
]
"""REFERENCE_RESULTS.md 1.2, to nine decimals or in closed form."""


def table_of(name, options=None):
    return read_table(gymnasium.make(name, **(options or {})))


@pytest.mark.parametrize(("name", "options", "optima"), OPTIMA)
def test_value_and_policy_iteration_agree_with_the_reference_and_each_other(name, options, optima):
    table = table_of(name, options)
    for gamma, optimum in optima.items():
        swept, solved = value_iteration(table, gamma), policy_iteration(table, gamma)
        assert swept.start_value(table) == pytest.approx(optimum, abs=1e-9)
        assert solved.start_value(table) == pytest.approx(optimum, abs=1e-9)
        np.testing.assert_allclose(swept.values, solved.values, rtol=0, atol=1e-9)
        np.testing.assert_allclose(action_values(table, solved.values, gamma).max(axis=1), solved.values, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("natural", "sab", "optimum"), [(False, True, -0.043113105), (False, False, -0.046555977), (True, False, -0.025729183)]
)
def test_blackjack_has_its_exact_value(natural, sab, optimum):
    table = blackjack_table(natural=natural, sab=sab)
    np.testing.assert_allclose(table.probabilities.sum(axis=2), 1.0, atol=1e-12)
    assert table.initial.sum() == pytest.approx(1.0, abs=1e-12)
    assert value_iteration(table, 1.0).start_value(table) == pytest.approx(optimum, abs=1e-9)
    assert policy_iteration(table, 1.0).start_value(table) == pytest.approx(optimum, abs=1e-9)


@pytest.mark.parametrize(
    ("name", "steps", "optimum"), [("FrozenLake-v1", 100, 0.744190288), ("FrozenLake8x8-v1", 200, 0.913220150), ("Taxi-v4", 200, 7.93)]
)
def test_the_best_policy_under_a_limit_depends_on_time(name, steps, optimum):
    table = table_of(name)
    solution = finite_horizon(table, steps)
    assert solution.start_value(table) == pytest.approx(optimum, abs=1e-9)
    assert solution.policy.shape == (steps, len(table.initial))
    assert not solution.values[-1].any()


@pytest.mark.parametrize(
    ("gamma", "four", "eight", "eight_short"), [(0.9, 0.729766017, 0.738575812, None), (0.99, 0.740164898, 0.862955380, 0.631738001)]
)
def test_stationary_policies_under_the_limit(gamma, four, eight, eight_short):
    small, large = table_of("FrozenLake-v1"), table_of("FrozenLake8x8-v1")
    policy = policy_iteration(large, gamma).policy
    assert small.initial @ policy_evaluation(small, policy_iteration(small, gamma).policy, 1.0, 100) == pytest.approx(four, abs=1e-9)
    assert large.initial @ policy_evaluation(large, policy, 1.0, 200) == pytest.approx(eight, abs=1e-9)
    if eight_short is not None:
        assert large.initial @ policy_evaluation(large, policy, 1.0, 100) == pytest.approx(eight_short, abs=1e-9)


def test_a_random_policy_is_evaluated_from_its_probabilities():
    table = table_of("FrozenLake-v1")
    uniform = np.full((16, 4), 0.25)
    assert table.initial @ policy_evaluation(table, uniform, 1.0, 100) == pytest.approx(0.01394, abs=1e-5)
    assert table.initial @ policy_evaluation(table, uniform, 1.0) == pytest.approx(0.01394, abs=1e-5)


def test_evaluation_solves_its_bellman_equation():
    table = table_of("Taxi-v4")
    policy = np.random.default_rng(0).integers(0, 6, 500)
    values = policy_evaluation(table, policy, 0.95)
    np.testing.assert_allclose(action_values(table, values, 0.95)[np.arange(500), policy], values, atol=1e-9)


def endless(reward):
    """One state; action 0 stays with `reward`, action 1 ends with reward 1."""
    return Table(
        probabilities=np.ones((1, 2, 1)),
        next_state=np.zeros((1, 2, 1), np.int32),
        reward=np.array([[[reward], [1.0]]]),
        terminated=np.array([[[False], [True]]]),
        initial=np.ones(1),
    )


def test_without_discount_a_policy_that_never_ends_is_worth_nothing_or_refused():
    stay = np.array([0])
    np.testing.assert_array_equal(policy_evaluation(endless(0.0), stay, 1.0), [0.0])
    with pytest.raises(UserError, match="for ever"):
        policy_evaluation(endless(-1.0), stay, 1.0)


def test_policy_iteration_without_discount_does_not_stay_for_ever():
    solution = policy_iteration(endless(-1.0), 1.0)
    assert (solution.policy.tolist(), solution.values.tolist()) == ([1], [1.0])


def test_rewards_for_ever_are_an_error_of_value_iteration():
    with pytest.raises(UserError, match="gamma"):
        value_iteration(endless(1.0), 1.0, max_iterations=50)


def test_a_policy_of_the_wrong_size_is_refused():
    with pytest.raises(UserError, match="16 states"):
        policy_evaluation(table_of("FrozenLake-v1"), np.full((16, 3), 1 / 3), 0.9)


@pytest.mark.parametrize("method", ["value_iteration", "policy_iteration", "finite_horizon"])
def test_plan_takes_the_method_of_its_config(method):
    table = table_of("FrozenLake-v1")
    solution = plan(table, Config(gamma=1.0, method=method, horizon=100))
    assert solution.start_value(table) == pytest.approx(0.744190288 if method == "finite_horizon" else 14 / 17, abs=1e-9)
