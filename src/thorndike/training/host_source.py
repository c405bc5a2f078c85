"""Rollouts of a host engine: the same moves as a compiled rollout, the engine stepped from Python, seeds an axis all the same.

One pool holds ``S x B`` environments; acting is compiled and vmapped over the ``S`` seeds.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

import jax
import numpy as np
from jaxtyping import Array, Key, PyTree

from thorndike.training.acting import Acting, acting
from thorndike.training.sources import FOR_WRAPPERS, by_iteration
from thorndike.training.time_shares import Clock
from thorndike.types import Algorithm, EnvSpec, EpisodeStats, Noise, Observation, Rollout, Source, Step, Wrapper


class HostEngine(Protocol):
    """A pool of environments outside JAX; arrays are NumPy, batch first."""

    spec: EnvSpec

    def reset(self, seeds: Sequence[int]) -> Observation:
        """Start every environment afresh, each from its own seed."""
        ...

    def step(self, actions: np.ndarray) -> Step:
        """Step every environment, resetting those that ended."""
        ...

    def close(self) -> None:
        """Free what the pool holds."""
        ...


class HostSourceState(NamedTuple):
    """What a host rollout carries to the next one; leaves lead with ``[S, B]`` (statistics with ``[S]``)."""

    obs: Observation
    seen: Observation
    memory: PyTree
    wrapper_memory: PyTree
    statistics: PyTree
    episode_return: np.ndarray
    episode_length: np.ndarray
    collected: int
    """Rollouts made so far: after every ``reseed_every``-th the pool is re-seeded, so that a resumed run equals an uninterrupted one."""


class HostSource(NamedTuple):
    """A ``Source`` whose functions lead with the seed axis, and the one move that compiled sources do not need."""

    source: Source
    restart: Callable[[PyTree, int], PyTree]
    """wrappers' statistics ``[S, ...]``, rollouts made -> the state that an uninterrupted run had there."""
    clock: Clock | None = None
    """How long the engine and the device took so far, in ``collect``."""


class Pool(NamedTuple):
    """A host engine's pool seen as ``[S, B]``."""

    engine: HostEngine
    seeds: int
    num_envs: int
    clock: Clock

    def reset(self, seeds: Sequence[int]) -> Observation:
        """First observations ``[S, B, ...]``."""
        with self.clock.environment:
            return jax.tree.map(self._by_seed, self.engine.reset(seeds))

    def step(self, action: Array) -> Step:
        """Actions ``[S, B, ...]`` -> Step ``[S, B, ...]``."""
        with self.clock.waiting:
            host = np.asarray(action)
        with self.clock.environment:
            step = self.engine.step(host.reshape((self.seeds * self.num_envs, *host.shape[2:])))
            numbers = (x.reshape(self.seeds, self.num_envs) for x in step[2:])
            return Step(jax.tree.map(self._by_seed, step.obs), jax.tree.map(self._by_seed, step.next_obs), *numbers)

    def _by_seed(self, x: np.ndarray) -> np.ndarray:
        return x.reshape((self.seeds, self.num_envs, *x.shape[1:]))


class Stepping(Protocol):
    """What a rollout needs of a pool."""

    def step(self, action: Array) -> Step:
        """Actions ``[S, B, ...]`` -> Step ``[S, B, ...]``."""
        ...


class Tally:
    """Running returns and lengths of the pool's episodes ``[S, B]``, of the environments' own rewards."""

    def __init__(self, episode_return: np.ndarray, episode_length: np.ndarray) -> None:
        """Start from the episodes under way."""
        self.total, self.age = episode_return.copy(), episode_length.copy()
        self.sums = np.zeros((4, *self.total.shape[:1]), np.float32)

    def forget(self) -> None:
        """The episodes under way will not be finished."""
        self.total[:], self.age[:] = 0.0, 0

    def add(self, step: Step) -> None:
        """Count a step; episodes that end in it are summed up and start again from 0."""
        self.total += step.reward * step.valid
        self.age += step.valid
        self.sums[3] += step.valid.sum(1)
        done = step.done & step.valid
        # Most steps end nothing, and each of these sums is a call.
        if done.any():
            self.sums[:3] += (done.sum(1), (self.total * done).sum(1), (self.age * done).sum(1))
            self.total[done], self.age[done] = 0.0, 0


def environment_seeds(seed: int, indices: Sequence[int], num_envs: int, *stream: int) -> list[int]:
    """One seed for each of ``len(indices) x num_envs`` environments.

    Seeds have 31 bits, the most that every environment takes, and follow from all arguments by hashing: among n of them n^2 / 2^32 pairs
    are equal by chance.
    """
    words = [np.random.SeedSequence([seed, index, *stream]).generate_state(num_envs) for index in indices]
    return [int(word) >> 1 for word in np.concatenate(words)]


def host_source(
    engine: HostEngine, algorithm: Algorithm, wrapper: Wrapper, seed: int, indices: Sequence[int], reseed_every: int
) -> HostSource:
    """Rollouts of ``engine``, whose pool is ``len(indices)`` seeds by ``B`` environments.

    The inner state of host environments cannot be saved, so after every ``reseed_every`` rollouts (where a checkpoint is made) all of them
    start afresh from (run seed, number of the checkpoint), interrupted or not; the step before counts as truncated.
    """
    seeds, length = len(indices), algorithm.needs.rollout_length
    spec = engine.spec._replace(num_envs=engine.spec.num_envs // seeds)
    pool = Pool(engine, seeds, spec.num_envs, Clock())
    moves = acting(algorithm, wrapper, spec.action_space, seeds, spec.num_envs)
    learn = jax.jit(jax.vmap(wrapper.learn)) if wrapper.name else lambda *unchanged: unchanged

    def start(statistics: PyTree, collected: int) -> HostSourceState:
        obs = pool.reset(environment_seeds(seed, indices, spec.num_envs, collected // reseed_every))
        return fresh_state(moves, statistics, obs, collected)

    def init(keys: Key[Array, " S"]) -> HostSourceState:
        def one(key: Key[Array, ""]) -> PyTree:
            return wrapper.randomize(wrapper.statistics(spec), jax.random.fold_in(key, FOR_WRAPPERS))

        return start(jax.vmap(one)(keys), 0)

    def collect(state: HostSourceState, actor: PyTree, noise: Noise) -> tuple[HostSourceState, Rollout, EpisodeStats]:
        collected = state.collected + 1
        ends_segment = collected % reseed_every == 0
        rolling = Rolling(moves, state)
        rolling.advance(pool, actor, noise, length)
        if ends_segment:
            rolling.rows[-1] = cut(rolling.rows[-1])
        statistics, wrapper_memory, rollout = learn(state.statistics, rolling.state.wrapper_memory, rolling.rollout())
        episodes = EpisodeStats(*rolling.tally.sums)
        if ends_segment:
            return start(statistics, collected), rollout, episodes
        return rolling.state._replace(wrapper_memory=wrapper_memory, statistics=statistics, collected=collected), rollout, episodes

    source = Source(
        init=init,
        draw=lambda key, iterations: by_iteration(algorithm.draw(key, iterations * length), iterations),
        collect=collect,
        statistics=lambda state: state.statistics,
        spec=wrapper.spec(spec),
        compiled=False,
    )
    return HostSource(source, start, pool.clock)


def fresh_state(moves: Acting, statistics: PyTree, obs: Observation, collected: int) -> HostSourceState:
    """Where every environment begins an episode; ``obs`` are their first observations ``[S, B, ...]``."""
    wrapper_memory, seen = moves.first_sight(statistics, obs)
    zeros = np.zeros(jax.tree.leaves(obs)[0].shape[:2], np.float32)
    return HostSourceState(obs, seen, moves.fresh_memory(), wrapper_memory, statistics, zeros, zeros.astype(np.int32), collected)


class Rolling:
    """A rollout under way. Where a step raises, it stands as after the last whole step."""

    def __init__(self, moves: Acting, state: HostSourceState) -> None:
        """Before its first step."""
        self.state, self.rows, self.memory = state, list[Rollout](), state.memory
        self.tally = Tally(state.episode_return, state.episode_length)
        self._moves = moves

    def advance(self, pool: Stepping, actor: PyTree, noise: Noise, length: int) -> None:
        """Step until there are ``length`` rows."""
        moves, statistics = self._moves, self.state.statistics
        obs, seen, memory, wrapper_memory = self.state.obs, self.state.seen, self.state.memory, self.state.wrapper_memory
        try:
            for t in range(len(self.rows), length):
                decision = moves.decide(actor, memory, seen, noise, np.int32(t))
                raw = pool.step(decision.engine_action)
                wrapper_memory, step = moves.see(statistics, wrapper_memory, obs, decision.engine_action, raw)
                self.rows.append(Rollout(seen, decision.action, decision.extras, step, ()))
                self.tally.add(raw)
                # The learner's episode, which a wrapper may end before the environment's.
                memory = moves.forget(step.done | ~step.valid, decision.memory)
                obs, seen = raw.obs, step.obs
        finally:
            self.state = self.state._replace(
                obs=obs,
                seen=seen,
                memory=memory,
                wrapper_memory=wrapper_memory,
                episode_return=self.tally.total,
                episode_length=self.tally.age,
            )

    def begin_again(self, obs: Observation) -> None:
        """Go on with other environments, whose first observations are ``obs``: the episodes under way are cut where they stood."""
        self.state = fresh_state(self._moves, self.state.statistics, obs, self.state.collected)
        self.tally.forget()
        if self.rows:
            self.rows[-1] = cut(self.rows[-1])
        else:
            self.memory = self.state.memory

    def rollout(self) -> Rollout:
        """The rows ``[S, T, B, ...]``."""
        return jax.tree.map(_stack, *self.rows)._replace(memory=self.memory)


def cut(rows: Rollout) -> Rollout:
    """The same row, or rows, with every episode that did not end there cut."""
    step = rows.step
    return rows._replace(step=step._replace(truncated=np.asarray(step.truncated) | ~np.asarray(step.terminated)))


def _stack(*rows: Array | np.ndarray) -> np.ndarray:
    return np.stack([np.asarray(row) for row in rows], axis=1)
