"""Lanes: agents that train side by side without a run directory of their own, and are scored at the end: a sweep's trials."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from thorndike.training.evaluation import evaluate
from thorndike.training.host_source import HostEngine, environment_seeds
from thorndike.training.policy import Policy
from thorndike.training.runner import Runner
from thorndike.training.segment import Carry, Report
from thorndike.types import EnvSpec, Observation, Step

_SCORING = 0x53434F52
"""Separates the episodes that score a lane from training and from later evaluations of the same seed."""
ENVIRONMENTS = 20
"""Environments in which a lane is scored side by side."""


class Trained(NamedTuple):
    """Lanes at the end of their training."""

    carry: Carry
    steps: tuple[int, ...]
    """Environment steps of each lane at the log points ``[P]``."""
    returns: np.ndarray
    """Mean return of the training episodes that ended since the log point before ``[P, S]``, NaN if none did."""
    failures: tuple[str | None, ...]
    """What was not finite in a lane, and by when ``[S]``."""


def train_lanes(runner: Runner, carry: Carry, iterations: int, log_every: int, tell: Callable[[int], None]) -> Trained:
    """Train from the first iteration to the last. A lane whose numbers are no longer finite goes on, and is told of.

    ``carry`` is consumed; ``tell`` is given the steps that each lane has made so far.
    """
    iteration = 0
    steps: list[int] = []
    returns: list[np.ndarray] = []
    failures: list[str | None] = [None] * len(carry.loop_key)
    while iteration < iterations:
        until = min(iteration + log_every, iterations)
        carry, report = runner.advance(carry, iteration, until - iteration)
        iteration = until
        steps.append(iteration * runner.steps_per_iteration)
        returns.append(_mean_returns(report))
        failures = [known or found for known, found in zip(failures, _not_finite(report, steps[-1]), strict=True)]
        tell(steps[-1])
    return Trained(carry, tuple(steps), np.array(returns), tuple(failures))


def score_lanes(policy: Policy, build: Callable[[int], HostEngine], agents: Sequence[int], episodes: int, seed: int) -> tuple[float, ...]:
    """The mean return of each lane's greedy policy over ``episodes`` fresh episodes on an engine of ``build(number of environments)``.

    ``agents`` are the lanes' numbers in their trials: lanes of the same number meet the same episodes, whatever lanes they are among.
    """
    found = evaluate(policy, lambda number: _SameEpisodes(build(number), agents, seed), episodes, seed, ENVIRONMENTS)
    return found.per_seed


def finite_actors(actors: PyTree) -> PyTree:
    """Actors without NaN or infinity: a lane that failed must not stop the others' evaluation."""
    return jax.tree.map(_finite, actors)


class _SameEpisodes:
    """A host engine whose environments start from seeds that follow from the lanes' agents, not from their places."""

    def __init__(self, engine: HostEngine, agents: Sequence[int], seed: int) -> None:
        """``engine`` holds as many environments for each lane."""
        self._engine = engine
        self._seeds = environment_seeds(seed, agents, engine.spec.num_envs // len(agents), _SCORING)
        self.spec: EnvSpec = engine.spec

    def reset(self, seeds: Sequence[int]) -> Observation:
        """Start every environment from the seed of its agent."""
        del seeds
        return self._engine.reset(self._seeds)

    def step(self, actions: np.ndarray) -> Step:
        """Step every environment."""
        return self._engine.step(actions)

    def close(self) -> None:
        """Free what the engine holds."""
        self._engine.close()


def _mean_returns(report: Report) -> np.ndarray:
    total, count = np.asarray(report.episodes.return_sum, np.float64), np.asarray(report.episodes.episodes, np.float64)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _not_finite(report: Report, steps: int) -> list[str | None]:
    """Of each lane the first of the learner's numbers that is not finite."""
    numbers = {name: np.asarray(values) for name, values in sorted(report.metrics.items()) if name.startswith("train/")}
    lanes = range(len(np.asarray(report.episodes.episodes)))
    return [
        next((f"{name} is not finite by step {steps}" for name, row in numbers.items() if not np.isfinite(row[i])), None) for i in lanes
    ]


def _finite(x: Array) -> Array:
    return jnp.nan_to_num(x) if jnp.issubdtype(x.dtype, jnp.floating) else x
