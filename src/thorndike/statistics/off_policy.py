"""The worth of a policy from episodes that another one made: NumPy only, float64.

Episodes are rows ``[E, T]`` padded at their ends: rewards with 0, probability ratios with 1. Ratios are target over behaviour.
"""

from typing import NamedTuple

import numpy as np

from thorndike.errors import UserError
from thorndike.statistics.estimates import Floats, percentile_interval

RESAMPLES = 2_000


class Logged(NamedTuple):
    """Recorded episodes ``[E, T]``."""

    reward: Floats
    ratio: Floats
    """Target's over the behaviour's probability of the action taken; 1 where nothing was done."""
    alive: Floats
    """1 for a step that was made, 0 for padding."""


class Estimate(NamedTuple):
    """A value with its 95 % interval, by bootstrap over episodes."""

    value: float
    ci95: tuple[float, float]


def padded(flat: Floats, lengths: Floats, filler: float) -> Floats:
    """Steps one after another ``[N]`` as rows ``[E, T]`` of so many steps each. Raises UserError if the numbers do not add up."""
    counts = np.asarray(lengths, np.int64)
    if counts.sum() != len(flat):
        raise UserError(f"episodes of {counts.sum()} steps in all, but {len(flat)} steps")
    rows = np.full((len(counts), counts.max()), filler)
    rows[np.arange(counts.max())[None] < counts[:, None]] = flat
    return rows


def prefix_weights(logged: Logged) -> Floats:
    """The product of the ratios up to each step, the step's own included: ``[E, T]``."""
    return np.asarray(np.cumprod(logged.ratio, axis=1), np.float64)


def per_decision(logged: Logged, gamma: float) -> Floats:
    """Per-decision importance sampling, one unbiased estimate an episode: ``sum_t gamma^t w_t r_t``. Precup et al. 2000, eq. 6."""
    return (_discounts(logged, gamma) * prefix_weights(logged) * logged.reward).sum(1)


def weighted_per_decision(logged: Logged, gamma: float, counts: Floats | None = None) -> Floats:
    """Per-decision importance sampling with each step's weights divided by their sum: biased, consistent, of far less variance.

    Thomas 2015 (thesis), section 3.7. ``counts [R, E]`` says how often each episode stands in each of R resamples; result ``[R]``.
    """
    times = np.ones((1, len(logged.reward))) if counts is None else counts
    weights = prefix_weights(logged)
    total = times @ weights
    gained = times @ (weights * logged.reward)
    share = np.divide(gained, total, out=np.zeros_like(gained), where=total > 0)
    return (share * _discounts(logged, gamma)).sum(1)


def doubly_robust(logged: Logged, q: Floats, v: Floats, tail: Floats, gamma: float) -> Floats:
    """One estimate an episode: ``D_t = V(s_t) + rho_t (r_t + gamma D_{t+1} - Q(s_t, a_t))``. Jiang and Li 2016 (arXiv:1511.03722), eq. 10.

    ``q`` and ``v`` are a model's values ``[E, T]`` under the target policy; ``tail [E]`` is what follows the last step: 0 after a
    termination, the model's value where the episode was cut. Right on average if either the model or the ratios are.
    """
    following = np.asarray(tail, np.float64)
    for t in range(logged.reward.shape[1] - 1, -1, -1):
        here = v[:, t] + logged.ratio[:, t] * (logged.reward[:, t] + gamma * following - q[:, t])
        following = np.where(logged.alive[:, t] > 0, here, following)
    return following


def effective_sample_size(logged: Logged, gamma: float) -> float:
    """How many episodes of the target policy these are worth: ``(sum w)^2 / sum w^2`` at each step, a mean weighted by ``gamma^t``.

    Kong 1992. Padding keeps an episode's last weight, as the estimators do. 0 if no episode has any weight.
    """
    weights = prefix_weights(logged)
    square, total = np.square(weights).sum(0), weights.sum(0)
    each = np.divide(np.square(total), square, out=np.zeros_like(total), where=square > 0)
    discount = gamma ** np.arange(weights.shape[1])
    return float((each * discount).sum() / discount.sum())


def bootstrapped_mean(values: Floats, seed: int = 0) -> Estimate:
    """The mean of one number an episode."""
    counts = resampled_counts(len(values), seed)
    return Estimate(float(np.mean(values)), percentile_interval(counts @ np.asarray(values, np.float64) / len(values)))


def bootstrapped_weighted(logged: Logged, gamma: float, seed: int = 0) -> Estimate:
    """``weighted_per_decision``, whole episodes drawn again."""
    resamples = weighted_per_decision(logged, gamma, resampled_counts(len(logged.reward), seed))
    return Estimate(float(weighted_per_decision(logged, gamma)[0]), percentile_interval(resamples))


def resampled_counts(episodes: int, seed: int) -> Floats:
    """How often each episode stands in each resample: ``[R, E]``."""
    generator = np.random.default_rng(seed)
    return generator.multinomial(episodes, np.full(episodes, 1.0 / episodes), size=RESAMPLES).astype(np.float64)


def tabular_values(
    state: Floats, action: Floats, reward: Floats, next_state: Floats, terminated: Floats, target: Floats, gamma: float
) -> Floats:
    """Fitted Q evaluation of a table, to its fixed point: ``Q [S, A]`` of the policy ``target [S, A]`` on the transitions' mean model.

    Le et al. 2019 (arXiv:1903.08738). Exact where the model is. Raises UserError where the target takes an action that the data lack.
    """
    states, actions = target.shape
    pair = np.asarray(state, np.int64) * actions + np.asarray(action, np.int64)
    seen = np.bincount(pair, minlength=states * actions).astype(np.float64)
    reached = np.unique(np.concatenate([np.asarray(state, np.int64), np.asarray(next_state, np.int64)[~np.asarray(terminated, bool)]]))
    lacking = [(s, a) for s in reached for a in np.flatnonzero(target[s] > 0) if seen[s * actions + a] == 0]
    if lacking:
        s, a = lacking[0]
        raise UserError(f"the data lack action {a} in state {s}, which the policy takes: record more, with a share of random actions")
    per_pair = np.maximum(seen, 1.0)
    mean_reward = np.bincount(pair, reward, states * actions) / per_pair
    moves = np.zeros((states * actions, states))
    np.add.at(moves, (pair, np.asarray(next_state, np.int64)), np.where(np.asarray(terminated, bool), 0.0, 1.0))
    moves /= per_pair[:, None]
    onwards = (moves[:, :, None] * target[None]).reshape(states * actions, states * actions)
    solved = np.linalg.solve(np.eye(states * actions) - gamma * onwards, mean_reward)
    return np.asarray(solved, np.float64).reshape(states, actions)


def _discounts(logged: Logged, gamma: float) -> Floats:
    return np.power(gamma, np.arange(logged.reward.shape[1])[None], dtype=np.float64)
