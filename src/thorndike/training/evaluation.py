"""Evaluation on fresh reference environments: the final policy, every seed, a fixed number of episodes of each environment."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple, cast

import jax
import numpy as np
from jaxtyping import Array, Int, PyTree

from thorndike.statistics import summary
from thorndike.training.acting import acting
from thorndike.training.host_source import HostEngine, Pool, environment_seeds
from thorndike.training.policy import Policy
from thorndike.training.time_shares import Clock
from thorndike.types import Observation, Step

_EVALUATION = 0x45564131
"""Separates the seeds of evaluation from those of training, whatever the run's seed is."""


class Episode(NamedTuple):
    """One evaluated episode, a line of evaluations.jsonl."""

    seed: int
    episode: int
    total: float
    length: int
    terminated: bool
    value: float | None = None
    """What the learner said that the first observation is worth; None where its values are on another scale than rewards."""
    discounted: float | None = None
    """What it was worth: the discounted return; what lies beyond a time limit by the learner's value of the observation it was cut at."""


class Bias(NamedTuple):
    """By how much the learner over-estimates the first observations of episodes, against what it then earned: above 0, too much."""

    mean: float
    ci95: tuple[float, float]
    """95 % interval of the mean, as that of the returns."""
    per_seed: tuple[float, ...]


class Evaluation(NamedTuple):
    """What an evaluation found. ``iqm``, ``min`` and ``ci95`` are over the seeds' means."""

    run: Path | None
    environment: str
    episodes: int
    """Episodes of each seed."""
    mean: float
    iqm: float
    min: float
    ci95: tuple[float, float]
    """95 % interval of the mean, by stratified bootstrap over seeds (over episodes where there is one seed)."""
    per_seed: tuple[float, ...]
    rows: tuple[Episode, ...]
    value_bias: Bias | None = None

    def __repr__(self) -> str:
        """The figures; the episodes, of which there are hundreds, are in ``rows``."""
        low, high = self.ci95
        figures = f"mean {self.mean:.4g} (95 % interval {low:.4g} to {high:.4g}), iqm {self.iqm:.4g}, min {self.min:.4g}"
        return f"Evaluation({self.environment}, {len(self.per_seed)} x {self.episodes} episodes: {figures})"


def evaluate(
    policy: Policy,
    build: Callable[[int], HostEngine],
    episodes: int = 100,
    seed: int = 0,
    num_envs: int = 20,
    deterministic: bool = True,
    gamma: float | None = None,
) -> Evaluation:
    """Run every seed of ``policy`` for ``episodes`` episodes on an engine of ``build(number of environments)``.

    Each environment plays the same number of episodes, so that short episodes are not over-represented. ``gamma`` is the discount of the
    learner's values, where they are to be compared with the returns.
    """
    seeds = policy.number_of_seeds
    num_envs = max(n for n in range(1, min(num_envs, episodes) + 1) if episodes % n == 0)
    engine = build(seeds * num_envs)
    try:
        rows = _play(policy, Pool(engine, seeds, num_envs, Clock()), episodes // num_envs, seed, deterministic, gamma)
    finally:
        engine.close()
    by_seed = [[row for row in rows if row.seed == policy.first + i] for i in range(seeds)]
    found = summary(np.array([[row.total for row in own] for own in by_seed]))
    bias = None if gamma is None else _bias(by_seed)
    return Evaluation(
        policy.run, engine.spec.id, episodes, found.mean, found.iqm, found.min, found.ci95, tuple(found.per_seed), tuple(rows), bias
    )


def _bias(by_seed: Sequence[Sequence[Episode]]) -> Bias:
    found = summary(np.array([[cast(float, row.value) - cast(float, row.discounted) for row in own] for own in by_seed]))
    return Bias(found.mean, found.ci95, tuple(found.per_seed))


class _Worth:
    """What the learner says of the beginnings of episodes, and what they turn out to be worth ``[S, N]``."""

    def __init__(self, policy: Policy, seeds: int, num_envs: int, gamma: float) -> None:
        """Nothing has begun yet."""
        self._values, self._actors, self._gamma = jax.jit(jax.vmap(policy.algorithm.value)), policy.actors, gamma
        self.said, self.earned, self._weight = (np.zeros((seeds, num_envs)) for _ in range(3))

    def begin(self, seen: Observation, first: np.ndarray) -> None:
        """Where an episode begins with what is seen, remember its value. The dead row of a next-step reset is passed over so."""
        if first.any():
            self.said = np.where(first, np.asarray(self._values(self._actors, seen)), self.said)
            self.earned, self._weight = np.where(first, 0.0, self.earned), np.where(first, 1.0, self._weight)

    def add(self, raw: Step, next_seen: Observation) -> None:
        """Count a step; what a time limit cuts off is worth what the learner says."""
        self.earned += self._weight * raw.reward * raw.valid
        self._weight = np.where(raw.valid, self._gamma * self._weight, self._weight)
        cut = raw.truncated & ~raw.terminated & raw.valid
        if cut.any():
            self.earned += np.where(cut, self._weight * np.asarray(self._values(self._actors, next_seen)), 0.0)


def _play(policy: Policy, pool: Pool, each: int, seed: int, deterministic: bool, gamma: float | None) -> list[Episode]:
    """Every environment plays ``each`` episodes to their ends."""
    seeds, num_envs = pool.seeds, pool.num_envs
    moves = acting(policy.algorithm, policy.wrapper, policy.spec.action_space, seeds, num_envs, greedy=deterministic)
    noise_of = jax.jit(lambda t: _noise(policy, seed, t, seeds, num_envs))
    obs = pool.reset(environment_seeds(seed, range(policy.first, policy.first + seeds), num_envs, _EVALUATION))
    wrapper_memory, seen = moves.first_sight(policy.statistics, obs)
    memory, noise, t = moves.fresh_memory(), noise_of(np.int32(0)), 0
    total, age = np.zeros((seeds, num_envs)), np.zeros((seeds, num_envs), np.int64)
    played = np.zeros((seeds, num_envs), np.int64)
    rows: list[Episode] = []
    worth = None if gamma is None else _Worth(policy, seeds, num_envs, gamma)
    while (played < each).any():
        if worth is not None:
            worth.begin(seen, (age == 0) & (played < each))
        decision = moves.decide(policy.actors, memory, seen, noise, np.int32(0))
        raw = pool.step(decision.engine_action)
        total += raw.reward * raw.valid
        age += raw.valid
        wrapper_memory, step = moves.see(policy.statistics, wrapper_memory, obs, decision.engine_action, raw)
        if worth is not None:
            worth.add(raw, step.next_obs)
        for s, e in np.argwhere(raw.done & raw.valid):
            if played[s, e] < each:
                number = int(e * each + played[s, e])
                values = () if worth is None else (float(worth.said[s, e]), float(worth.earned[s, e]))
                rows.append(Episode(policy.first + int(s), number, float(total[s, e]), int(age[s, e]), bool(raw.terminated[s, e]), *values))
            played[s, e] += 1
            total[s, e], age[s, e] = 0.0, 0
        memory = moves.forget(step.done | ~step.valid, decision.memory)
        obs, seen, t = raw.obs, step.obs, t + 1
        # The greedy policy ignores its noise; drawing it anew each step would only cost time.
        noise = noise if deterministic else noise_of(np.int32(t))
    return sorted(rows)


def _noise(policy: Policy, seed: int, t: Int[Array, ""], seeds: int, num_envs: int) -> PyTree:
    """Noise ``[S, 1, N, ...]`` of one step."""
    key = jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), _EVALUATION), t)
    drawn = jax.vmap(lambda k: policy.noise(k, num_envs))(jax.random.split(key, seeds))
    return jax.tree.map(lambda x: x[:, None], drawn)
