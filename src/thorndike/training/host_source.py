"""Rollouts of a host engine: the same moves as a compiled rollout, the engine stepped from Python, seeds an axis all the same.

One pool holds ``S x B`` environments; acting is compiled and vmapped over the ``S`` seeds.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key, PyTree

from thorndike.training.sources import to_environment, where_done
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
    """Rollouts made so far: at every ``reseed_every``-th the pool is re-seeded, so that a resumed run sees what an uninterrupted one sees."""


class HostSource(NamedTuple):
    """A ``Source`` whose functions lead with the seed axis, and the one move that compiled sources do not need."""

    source: Source
    restart: Callable[[PyTree, int], HostSourceState]
    """wrappers' statistics ``[S, ...]``, rollouts made -> the state that an uninterrupted run had there."""


def environment_seeds(seed: int, indices: Sequence[int], num_envs: int, segment: int) -> list[int]:
    """One 31-bit seed for each of ``len(indices) x num_envs`` environments; streams of different arguments never meet."""
    words = [np.random.SeedSequence([seed, index, segment]).generate_state(num_envs) for index in indices]
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
    learner_spec, num_envs = wrapper.spec(spec), spec.num_envs
    identity = not wrapper.name

    def by_seed(x: np.ndarray) -> np.ndarray:
        return x.reshape((seeds, num_envs, *x.shape[1:]))

    def act_one(actor: PyTree, memory: PyTree, seen: Observation, noise: Noise, t: Array) -> tuple[PyTree, ...]:
        memory, action, extras = algorithm.act(actor, memory, seen, jax.tree.map(lambda x: x[t], noise))
        return memory, action, to_environment(spec.action_space, action), extras

    decide = jax.jit(jax.vmap(act_one, in_axes=(0, 0, 0, 0, None)))
    see = jax.jit(jax.vmap(wrapper.step))
    first_sight = jax.jit(jax.vmap(wrapper.init))
    learn = jax.jit(jax.vmap(wrapper.learn))
    forget = jax.jit(jax.vmap(lambda done, memory: where_done(done, algorithm.memory(num_envs), memory)))
    steps = [np.int32(t) for t in range(length)]

    def start(statistics: PyTree, collected: int) -> HostSourceState:
        segment = collected // reseed_every
        obs = jax.tree.map(by_seed, engine.reset(environment_seeds(seed, indices, num_envs, segment)))
        wrapper_memory, seen = first_sight(statistics, obs)
        memory = jax.tree.map(lambda x: jnp.broadcast_to(x, (seeds, *x.shape)), algorithm.memory(num_envs))
        zeros = np.zeros((seeds, num_envs), np.float32)
        return HostSourceState(obs, seen, memory, wrapper_memory, statistics, zeros, zeros.astype(np.int32), collected)

    def init(keys: Key[Array, " S"]) -> HostSourceState:
        statistics = jax.tree.map(lambda x: jnp.broadcast_to(x, (seeds, *jnp.shape(x))), wrapper.statistics(spec))
        return start(statistics, 0)

    def draw(key: Key[Array, ""]) -> Noise:
        return algorithm.draw(key, length)

    def collect(state: HostSourceState, actor: PyTree, noise: Noise) -> tuple[HostSourceState, Rollout, EpisodeStats]:
        obs, seen, memory, wrapper_memory = state.obs, state.seen, state.memory, state.wrapper_memory
        total, age = state.episode_return.copy(), state.episode_length.copy()
        counts = np.zeros((4, seeds), np.float32)
        rows, memory_before = [], memory
        collected = state.collected + 1
        ending = collected % reseed_every == 0
        for t in steps:
            memory, action, engine_action, extras = decide(actor, memory, seen, noise, t)
            host_action = np.asarray(engine_action)
            raw = jax.tree.map(by_seed, engine.step(host_action.reshape((seeds * num_envs, *host_action.shape[2:]))))
            if identity:
                step = raw
            else:
                wrapper_memory, step = see(state.statistics, wrapper_memory, obs, engine_action, raw)
            rows.append((seen, action, extras, step))
            total += raw.reward * raw.valid
            age += raw.valid
            done = raw.done & raw.valid
            counts += (done.sum(1), (total * done).sum(1), (age * done).sum(1), raw.valid.sum(1))
            total[done], age[done] = 0.0, 0
            if jax.tree.leaves(memory):
                memory = forget(done, memory)
            obs, seen = raw.obs, step.obs
        if ending:
            rows[-1] = (*rows[-1][:3], step._replace(truncated=np.asarray(step.truncated) | ~np.asarray(step.terminated)))
        rollout = Rollout(*jax.tree.map(_stack, *rows), memory_before)
        statistics = state.statistics
        if not identity:
            statistics, wrapper_memory, rollout = learn(statistics, wrapper_memory, rollout)
        stats = EpisodeStats(*counts)
        if ending:
            return start(statistics, collected), rollout, stats
        return HostSourceState(obs, seen, memory, wrapper_memory, statistics, total, age, collected), rollout, stats

    source = Source(init, draw, collect, lambda state: state.statistics, learner_spec, compiled=False)
    return HostSource(source, start)


def _stack(*rows: Array | np.ndarray) -> np.ndarray:
    """Rows ``[S, B, ...]`` of T steps to ``[S, T, B, ...]``."""
    return np.stack([np.asarray(row) for row in rows], axis=1)
