"""Estimates of a policy's worth against slow loops, and against a chain whose truth is known."""

import numpy as np
import pytest

from thorndike.errors import UserError
from thorndike.statistics.off_policy import (
    Logged,
    bootstrapped_mean,
    bootstrapped_weighted,
    doubly_robust,
    effective_sample_size,
    padded,
    per_decision,
    tabular_values,
    weighted_per_decision,
)

GAMMA, STATES, ACTIONS, HORIZON = 0.9, 3, 2, 6
DICE = np.random.default_rng(5)
MOVES = DICE.dirichlet(np.ones(STATES), size=(STATES, ACTIONS))
PAY = DICE.normal(size=(STATES, ACTIONS))
TARGET = DICE.dirichlet(np.ones(ACTIONS), size=STATES)
BEHAVIOR = np.full((STATES, ACTIONS), 0.5)


def true_values():
    """``Q [HORIZON + 1, S, A]`` and ``V`` by the number of steps made, which a horizon makes part of the state."""
    q, v = np.zeros((HORIZON + 1, STATES, ACTIONS)), np.zeros((HORIZON + 1, STATES))
    for t in reversed(range(HORIZON)):
        q[t] = PAY + GAMMA * MOVES @ v[t + 1]
        v[t] = (TARGET * q[t]).sum(1)
    return q, v


Q, V = true_values()


def episodes(count, dice):
    """States, actions, rewards ``[count, HORIZON]`` of the behaviour, from state 0."""
    states, actions = np.zeros((count, HORIZON), int), np.zeros((count, HORIZON), int)
    state = np.zeros(count, int)
    for t in range(HORIZON):
        states[:, t], actions[:, t] = state, (dice.random(count) < BEHAVIOR[state, 1]).astype(int)
        below = MOVES[state, actions[:, t]].cumsum(1)
        state = np.minimum((below < dice.random((count, 1))).sum(1), STATES - 1)
    return states, actions, PAY[states, actions]


def logged(count, dice, target=TARGET, behavior=BEHAVIOR):
    states, actions, rewards = episodes(count, dice)
    ratio = target[states, actions] / behavior[states, actions]
    return Logged(rewards, ratio, np.ones_like(rewards)), states, actions


def model(states, actions, q=Q, v=V):
    time = np.arange(HORIZON)[None]
    return q[time, states, actions], v[time, states]


def test_per_decision_and_weighted_are_their_slow_loops():
    log, *_ = logged(7, np.random.default_rng(0))
    each, numerator, denominator = np.zeros(7), np.zeros(HORIZON), np.zeros(HORIZON)
    for i in range(7):
        weight = 1.0
        for t in range(HORIZON):
            weight *= log.ratio[i, t]
            each[i] += GAMMA**t * weight * log.reward[i, t]
            numerator[t] += weight * log.reward[i, t]
            denominator[t] += weight
    np.testing.assert_allclose(per_decision(log, GAMMA), each)
    np.testing.assert_allclose(weighted_per_decision(log, GAMMA), [(GAMMA ** np.arange(HORIZON) * numerator / denominator).sum()])


def test_doubly_robust_is_its_slow_loop_and_stops_where_an_episode_ended():
    log, states, actions = logged(4, np.random.default_rng(1))
    q, v = model(states, actions)
    lengths, tail = [6, 2, 4, 1], np.array([0.5, 0.0, -1.0, 2.0])
    alive = (np.arange(HORIZON)[None] < np.array(lengths)[:, None]).astype(float)
    slow = []
    for i, length in enumerate(lengths):
        after = tail[i]
        for t in reversed(range(length)):
            after = v[i, t] + log.ratio[i, t] * (log.reward[i, t] + GAMMA * after - q[i, t])
        slow.append(after)
    np.testing.assert_allclose(doubly_robust(log._replace(alive=alive), q, v, tail, GAMMA), slow)


def test_the_same_policy_has_ratios_of_one_and_is_worth_its_mean_return():
    log, *_ = logged(50, np.random.default_rng(2), target=BEHAVIOR)
    returns = (log.reward * GAMMA ** np.arange(HORIZON)).sum(1)
    np.testing.assert_allclose(per_decision(log, GAMMA), returns)
    np.testing.assert_allclose(weighted_per_decision(log, GAMMA)[0], returns.mean())
    assert effective_sample_size(log, GAMMA) == pytest.approx(50)


WRONG_Q = Q + np.random.default_rng(9).normal(size=Q.shape)
WRONG_V = (TARGET * WRONG_Q).sum(-1)
"""A model that is wrong, but whose values of states are those of its own actions under the target, as any fitted one's are."""


@pytest.mark.parametrize(
    ("q", "v", "behavior"),
    [(Q, V, BEHAVIOR), (WRONG_Q, WRONG_V, BEHAVIOR), (Q, V, np.array([[0.3, 0.7]] * STATES))],
    ids=["both right", "the probabilities right", "the model right"],
)
def test_doubly_robust_is_unbiased_when_either_the_model_or_the_probabilities_are_right(q, v, behavior):
    """Over 200 logs of 20 episodes: less than two standard errors off."""
    dice, found = np.random.default_rng(3), []
    for _ in range(200):
        log, states, actions = logged(20, dice, behavior=behavior)
        found.append(doubly_robust(log, *model(states, actions, q, v), np.zeros(20), GAMMA).mean())
    assert abs(np.mean(found) - V[0, 0]) < 2 * np.std(found) / 200**0.5


def test_doubly_robust_is_biased_when_both_are_wrong_and_less_variable_than_importance_sampling():
    dice, robust, sampled, off = np.random.default_rng(4), [], [], []
    for _ in range(200):
        log, states, actions = logged(20, dice)
        robust.append(doubly_robust(log, *model(states, actions), np.zeros(20), GAMMA).mean())
        sampled.append(per_decision(log, GAMMA).mean())
        skewed = log._replace(ratio=log.ratio * 1.5)
        off.append(doubly_robust(skewed, *model(states, actions, WRONG_Q, WRONG_V), np.zeros(20), GAMMA).mean())
    assert abs(np.mean(off) - V[0, 0]) > 4 * np.std(off) / 200**0.5
    assert np.var(robust) < np.var(sampled)
    assert abs(np.mean(sampled) - V[0, 0]) < 3 * np.std(sampled) / 200**0.5


def test_weighted_importance_sampling_is_consistent():
    errors = [abs(weighted_per_decision(logged(n, np.random.default_rng(6))[0], GAMMA)[0] - V[0, 0]) for n in (10, 100_000)]
    assert errors[1] < 0.02


def test_fitted_q_of_a_table_is_the_exact_value_where_all_pairs_are_covered():
    """A deterministic chain with an absorbing end, each pair once: the value by solving Bellman's equation."""
    successor = np.array([[1, 2], [2, 0], [0, 1]])
    ends = np.array([[False, False], [False, True], [False, False]])
    pairs = [(s, a) for s in range(3) for a in range(2)]
    state, action = np.array(pairs).T
    reward, following, terminated = PAY[state, action], successor[state, action], ends[state, action]
    found = tabular_values(state, action, reward, following, terminated, TARGET, GAMMA)
    q = np.zeros((3, 2))
    for _ in range(2_000):
        v = (TARGET * q).sum(1)
        q = np.array([[PAY[s, a] + GAMMA * (0.0 if ends[s, a] else v[successor[s, a]]) for a in range(2)] for s in range(3)])
    np.testing.assert_allclose(found, q, atol=1e-6)


def test_fitted_q_of_a_table_refuses_actions_that_the_data_lack():
    with pytest.raises(UserError, match="the data lack action 1 in state 0"):
        tabular_values(np.array([0]), np.array([0]), np.array([1.0]), np.array([0]), np.array([True]), TARGET[:1], GAMMA)


def test_effective_sample_size_is_one_when_one_episode_has_all_the_weight():
    ratio = np.ones((10, 3))
    ratio[1:, 0] = 0.0
    log = Logged(np.ones((10, 3)), ratio, np.ones((10, 3)))
    assert effective_sample_size(log, 0.5) == pytest.approx(1.0)
    assert effective_sample_size(log._replace(ratio=np.zeros((10, 3))), 0.5) == 0.0


def test_intervals_cover_the_truth_about_as_often_as_they_say():
    dice, covered = np.random.default_rng(8), {"mean": 0, "weighted": 0}
    for _ in range(100):
        log, *_ = logged(60, dice)
        for name, found in (("mean", bootstrapped_mean(per_decision(log, GAMMA))), ("weighted", bootstrapped_weighted(log, GAMMA))):
            low, high = found.ci95
            assert low <= found.value <= high
            covered[name] += low <= V[0, 0] <= high
    assert all(85 <= count <= 100 for count in covered.values()), covered


def test_padding_refuses_lengths_that_do_not_add_up():
    np.testing.assert_array_equal(padded(np.array([1.0, 2.0, 3.0]), np.array([1, 2]), 9.0), [[1.0, 9.0], [2.0, 3.0]])
    with pytest.raises(UserError, match="3 steps in all, but 2"):
        padded(np.array([1.0, 2.0]), np.array([1, 2]), 0.0)
