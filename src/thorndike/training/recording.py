"""Episodes of a policy on reference environments, written down step by step, with the probability of every Discrete action."""

from collections.abc import Callable
from typing import NamedTuple, cast

import gymnasium
import jax
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from thorndike.errors import UserError
from thorndike.training.acting import acting
from thorndike.training.datasets import Episode
from thorndike.training.host_source import HostEngine, Pool, environment_seeds
from thorndike.training.policy import Policy
from thorndike.training.sources import to_environment
from thorndike.training.time_shares import Clock
from thorndike.types import Observation, Step

_RECORDING = 0x52454344
"""Separates the seeds of recording from those of training and evaluation."""


class Behavior(NamedTuple):
    """How actions are chosen."""

    deterministic: bool
    """By the evaluation policy, else as the policy acted while it learnt."""
    random_share: float
    """The probability with which an action is uniform instead."""


class Wanted(NamedTuple):
    """How much is recorded: so many whole episodes, or whole episodes until there are so many steps."""

    episodes: int | None
    steps: int | None


def action_probabilities(policy: Policy, deterministic: bool) -> Callable[[PyTree, PyTree, Observation], Float[Array, "B A"]] | None:
    """Actor, memory, seen obs -> what each Discrete action is chosen with; None for other actions.

    Raises ``UserError`` for a learner that explores in a way whose probabilities nobody can tell.
    """
    space = policy.spec.action_space
    if not isinstance(space, gymnasium.spaces.Discrete):
        return None
    if not deterministic:
        if policy.algorithm.probabilities is None:
            raise UserError("this policy does not tell the probabilities of its actions: take the best one of each, --deterministic")
        return policy.algorithm.probabilities
    draw, greedy, count = policy.noise, policy.algorithm.greedy, int(space.n)

    def best(actor: PyTree, memory: PyTree, obs: Observation) -> Float[Array, "B A"]:
        noise = draw(jax.random.key(0), jax.tree.leaves(obs)[0].shape[0])
        return jax.nn.one_hot(greedy(actor, memory, obs, noise)[1], count)

    return best


def record_episodes(
    policy: Policy, build: Callable[[int], HostEngine], wanted: Wanted, behavior: Behavior, seed: int, num_envs: int = 20
) -> list[Episode]:
    """Whole episodes of one agent. Every environment plays the same number of them, so that short ones are not over-represented."""
    number = 1
    if wanted.episodes is not None:
        number = max(n for n in range(1, min(num_envs, wanted.episodes) + 1) if wanted.episodes % n == 0)
    engine = build(number)
    try:
        return _Recorder(policy, Pool(engine, 1, number, Clock()), behavior, seed).play(wanted)
    finally:
        engine.close()


class _Recorder:
    """A pool being played."""

    def __init__(self, policy: Policy, pool: Pool, behavior: Behavior, seed: int) -> None:
        self._policy, self._pool, self._behavior, self._seed = policy, pool, behavior, seed
        self._space, self._chance = policy.spec.action_space, action_probabilities(policy, behavior.deterministic)
        self._moves = acting(policy.algorithm, policy.wrapper, self._space, 1, pool.num_envs, greedy=behavior.deterministic)
        self._decide = jax.jit(self._decision)
        self._dice = np.random.default_rng([seed, policy.first, _RECORDING])
        self._rows: list[list[tuple]] = [[] for _ in range(pool.num_envs)]
        self._done: list[list[Episode]] = [[] for _ in range(pool.num_envs)]

    def play(self, wanted: Wanted) -> list[Episode]:
        policy, pool = self._policy, self._pool
        agent = jax.tree.map(lambda x: x[policy.best : policy.best + 1], (policy.actors, policy.statistics))
        seeds = environment_seeds(self._seed, [policy.first + policy.best], pool.num_envs, _RECORDING)
        obs = pool.reset(seeds)
        wrapper_memory, seen = self._moves.first_sight(agent[1], obs)
        memory, t = self._moves.fresh_memory(), 0
        while not self._enough(wanted):
            later, proposed, chances = self._decide(agent[0], memory, seen, np.int32(t))
            action, probability = self._choose(np.asarray(proposed), None if chances is None else np.asarray(chances))
            raw = pool.step(cast(Array, action[None]))
            self._write(obs, action, raw, probability)
            wrapper_memory, step = self._moves.see(agent[1], wrapper_memory, obs, cast(Array, action[None]), raw)
            memory = self._moves.forget(raw.done | ~raw.valid, later)
            obs, seen, t = raw.obs, step.obs, t + 1
        limit = None if wanted.episodes is None else wanted.episodes // pool.num_envs
        found = [episode for row in self._done for episode in row[:limit]]
        return [episode._replace(seed=seeds[0]) if i == 0 and pool.num_envs == 1 else episode for i, episode in enumerate(found)]

    def _decision(self, actor: PyTree, memory: PyTree, seen: Observation, t: Int[Array, ""]) -> tuple[PyTree, Array, Array | None]:
        """One decision; actor, memories and observations lead with an axis of one seed."""
        actor, memory, seen = jax.tree.map(lambda x: x[0], (actor, memory, seen))
        noise = self._policy.noise(jax.random.fold_in(jax.random.fold_in(jax.random.key(self._seed), _RECORDING), t), self._pool.num_envs)
        choose = self._policy.algorithm.greedy if self._behavior.deterministic else self._policy.algorithm.act
        later, action, _ = choose(actor, memory, seen, noise)
        chances = None if self._chance is None else self._chance(actor, memory, seen)
        return jax.tree.map(lambda x: x[None], later), to_environment(self._space, action), chances

    def _choose(self, proposed: np.ndarray, chances: np.ndarray | None) -> tuple[np.ndarray, np.ndarray | None]:
        """Actions of the behaviour in the environment's units, and their probabilities."""
        share, count = self._behavior.random_share, self._pool.num_envs
        if chances is not None:
            wide = chances.astype(np.float64)
            wide = (1.0 - share) * wide / wide.sum(1, keepdims=True) + share / wide.shape[1]
            below = np.cumsum(wide, axis=1)
            action = np.minimum((below < self._dice.random((count, 1)) * below[:, -1:]).sum(1), wide.shape[1] - 1)
            return action.astype(np.int32), wide[np.arange(count), action]
        uniform = np.stack([self._at_random() for _ in range(count)])
        chosen = self._dice.random(count) < share
        return np.where(chosen.reshape((count,) + (1,) * (proposed.ndim - 1)), uniform, proposed).astype(proposed.dtype), None

    def _at_random(self) -> np.ndarray:
        space = self._space
        if isinstance(space, gymnasium.spaces.Box):
            return self._dice.uniform(space.low, space.high)
        most = space.nvec if isinstance(space, gymnasium.spaces.MultiDiscrete) else np.full(space.shape or (), 2)
        return self._dice.integers(most)

    def _write(self, obs: Observation, action: np.ndarray, raw: Step, probability: np.ndarray | None) -> None:
        for row, kept in enumerate(self._rows):
            if not raw.valid[0, row]:
                continue
            seen, following = (jax.tree.map(lambda x, row=row: x[0, row], tree) for tree in (obs, raw.next_obs))
            terminated, truncated = bool(raw.terminated[0, row]), bool(raw.truncated[0, row])
            kept.append((seen, action[row], raw.reward[0, row], terminated, truncated, None if probability is None else probability[row]))
            if terminated or truncated:
                self._done[row].append(_episode(kept, following, self._space))
                kept.clear()

    def _enough(self, wanted: Wanted) -> bool:
        if wanted.episodes is not None:
            return min(map(len, self._done)) >= wanted.episodes // len(self._done)
        return sum(len(episode.reward) for episode in self._done[0]) >= (wanted.steps or 0)


def _episode(rows: list[tuple], last: Observation, space: gymnasium.Space) -> Episode:
    obs, action, reward, terminated, truncated, probability = zip(*rows, strict=True)
    start = np.asarray(space.start) if isinstance(space, gymnasium.spaces.Discrete | gymnasium.spaces.MultiDiscrete) else 0
    return Episode(
        jax.tree.map(lambda *leaves: np.stack(leaves), *obs, last),
        np.stack(action) + start if not isinstance(space, gymnasium.spaces.Box) else np.clip(np.stack(action), space.low, space.high),
        np.array(reward, np.float32),
        np.array(terminated),
        np.array(truncated),
        None if probability[0] is None else np.array(probability, np.float64),
    )
