"""Where batches come from: a rollout compiled with its environment, or one stepped in a host engine from Python.

Both follow the same four moves a step: ``act``, the engine, the wrappers, memory reset where an episode ended.
"""

from typing import NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from thorndike.types import Action, Algorithm, Environment, EpisodeStats, Noise, Observation, Rollout, Source, Step, Wrapper

_SMALL_ROLLOUT = 16_384
"""Numbers in the observations of a rollout that is copied in no time."""


class SourceState(NamedTuple):
    """What a rollout carries to the next one."""

    environment: PyTree
    obs: Observation
    """The engine's own observation ``[B, ...]``."""
    seen: Observation
    """The observation as the wrappers show it to the learner."""
    memory: PyTree
    wrapper_memory: PyTree
    statistics: PyTree
    """The wrappers' learnt statistics."""
    episode_return: Float[Array, "*batch"]
    episode_length: Int[Array, "*batch"]


class Emitted(NamedTuple):
    """One step's row of a compiled rollout: what is constant, or follows from the next row, is put back after the scan."""

    seen: Observation
    action: Action
    extras: PyTree
    next_seen: Observation
    reward: Float[Array, "*batch"]
    terminated: Bool[Array, "*batch"]
    truncated: Bool[Array, "*batch"]
    finished_return: Float[Array, "*batch"]
    finished_length: Float[Array, "*batch"]


def to_environment(space: gymnasium.Space, action: Action) -> Action:
    """The environment's action for the learner's: Box actions are clipped to [-1, 1] and mapped to the bounds, others go through.

    Boxes without finite bounds go through too.
    """
    if not isinstance(space, gymnasium.spaces.Box) or not (np.isfinite(space.low).all() and np.isfinite(space.high).all()):
        return action
    leading = (1,) * (action.ndim - space.low.ndim)
    low, high = (bound.astype(np.float32).reshape(leading + bound.shape) for bound in (space.low, space.high))
    return low + (jnp.clip(action, -1.0, 1.0) + 1.0) * (0.5 * (high - low))


def _numbers_of(space: gymnasium.Space) -> int:
    """How many numbers an observation has, every part of it."""
    return sum(np.size(leaf) for leaf in jax.tree.leaves(space.sample()))


def by_iteration(noise: Noise, iterations: int) -> Noise:
    """Noise ``[iterations * T, ...]`` as ``[iterations, T, ...]``."""
    return jax.tree.map(lambda x: x.reshape((iterations, -1, *x.shape[1:])), noise)


def where_done(done: Array, chosen: PyTree, otherwise: PyTree) -> PyTree:
    """``where`` over leaves ``[B, ...]`` by a flag ``[B]``."""

    def choose(x: Array, y: Array) -> Array:
        return jnp.where(done.reshape(done.shape + (1,) * (x.ndim - done.ndim)), x, y)

    return jax.tree.map(choose, chosen, otherwise)


def gathered(emitted: Emitted, last_seen: Observation) -> Step:
    """The steps of a rollout. Compiled engines reset within the step, so every row is a transition."""
    last = jax.tree.map(lambda x: x[None], last_seen)
    return Step(
        obs=jax.tree.map(lambda rows, last: jnp.concatenate([rows[1:], last]), emitted.seen, last),
        next_obs=emitted.next_seen,
        reward=emitted.reward,
        cost=jnp.zeros_like(emitted.reward),
        terminated=emitted.terminated,
        truncated=emitted.truncated,
        valid=jnp.ones(emitted.reward.shape, bool),
    )


def episodes_of(emitted: Emitted) -> EpisodeStats:
    """The episodes that ended in a rollout."""
    return EpisodeStats(
        episodes=jnp.sum(emitted.terminated | emitted.truncated, dtype=jnp.float32),
        return_sum=jnp.sum(emitted.finished_return),
        length_sum=jnp.sum(emitted.finished_length),
        steps=jnp.full((), emitted.reward.size, jnp.float32),
    )


def compiled_source(environment: Environment, algorithm: Algorithm, wrapper: Wrapper) -> Source:
    """Rollouts of a compiled environment: pure, traced together with the learner."""
    spec, length = environment.spec, algorithm.needs.rollout_length
    learner_spec = wrapper.spec(spec)
    # Two steps a round: half of the copies that a round makes of what it carries fall away (PPO on CartPole: 10 % of a step). But where two
    # rows are written in a round XLA copies what is written into, so that large observations are the slower for it (MinAtar: 1.7x).
    unroll = 2 if length * spec.num_envs * _numbers_of(learner_spec.observation_space) <= _SMALL_ROLLOUT else 1

    def init(key: Key[Array, ""]) -> SourceState:
        state, obs = environment.init(key)
        statistics = wrapper.statistics(spec)
        wrapper_memory, seen = wrapper.init(statistics, obs)
        zeros = jnp.zeros((spec.num_envs,), jnp.float32)
        return SourceState(
            state, obs, seen, algorithm.memory(spec.num_envs), wrapper_memory, statistics, zeros, jnp.zeros((spec.num_envs,), jnp.int32)
        )

    def draw(key: Key[Array, ""], iterations: int) -> Noise:
        key_act, key_environment = jax.random.split(key)
        flat = algorithm.draw(key_act, iterations * length), environment.draw(key_environment, iterations * length)
        return by_iteration(flat, iterations)

    def one_step(state: SourceState, actor: PyTree, noise: Noise) -> tuple[SourceState, Emitted]:
        noise_act, noise_environment = noise
        memory, action, extras = algorithm.act(actor, state.memory, state.seen, noise_act)
        engine_action = to_environment(spec.action_space, action)
        inner, raw = environment.step(state.environment, engine_action, noise_environment)
        wrapper_memory, step = wrapper.step(state.statistics, state.wrapper_memory, state.obs, engine_action, raw)
        done = raw.done
        total, steps = state.episode_return + raw.reward, state.episode_length + 1
        emitted = Emitted(
            state.seen,
            action,
            extras,
            step.next_obs,
            step.reward,
            step.terminated,
            step.truncated,
            jnp.where(done, total, 0.0),
            jnp.where(done, steps, 0).astype(jnp.float32),
        )
        if jax.tree.leaves(memory):
            memory = where_done(done, algorithm.memory(spec.num_envs), memory)
        following = SourceState(
            inner, raw.obs, step.obs, memory, wrapper_memory, state.statistics, jnp.where(done, 0.0, total), jnp.where(done, 0, steps)
        )
        return following, emitted

    def collect(state: SourceState, actor: PyTree, noise: Noise) -> tuple[SourceState, Rollout, EpisodeStats]:
        memory = state.memory
        if length == 1:
            state, emitted = one_step(state, actor, jax.tree.map(lambda x: x[0], noise))
            emitted = jax.tree.map(lambda x: x[None], emitted)
        else:
            state, emitted = jax.lax.scan(lambda carry, row: one_step(carry, actor, row), state, noise, unroll=unroll)
        rollout = Rollout(emitted.seen, emitted.action, emitted.extras, gathered(emitted, state.seen), memory)
        stats = episodes_of(emitted)
        statistics, wrapper_memory, rollout = wrapper.learn(state.statistics, state.wrapper_memory, rollout)
        return state._replace(statistics=statistics, wrapper_memory=wrapper_memory), rollout, stats

    return Source(init, draw, collect, lambda state: state.statistics, learner_spec, compiled=True)
