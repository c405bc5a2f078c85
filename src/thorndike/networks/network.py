"""What a network is to the rest of the library: pure functions. A user's own network is any pair of ``init`` and ``apply``."""

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Key, PyTree

from thorndike.types import EnvSpec, Observation, Rollout


class Recurrence(NamedTuple):
    """What a network with memory adds. A memory is a pytree of arrays ``[B, ...]``; an episode begins with ``fresh``."""

    fresh: Callable[[int], PyTree]
    """batch size -> the memory an episode begins with."""
    step: Callable[[PyTree, PyTree, Observation], tuple[PyTree, PyTree]]
    """parameters, memory, observation ``[B, ...]`` -> memory, outputs."""
    unroll: Callable[[PyTree, PyTree, Observation, Bool[Array, "T B"]], tuple[PyTree, PyTree]]
    """parameters, memory before the first step, observations ``[T, B, ...]``, which steps begin an episode -> the memory after each step
    ``[T, B, ...]``, outputs ``[T, B, ...]``."""


def _as_it_is(params: PyTree) -> PyTree:
    return params


class Network(NamedTuple):
    """A function of the observation with parameters."""

    init: Callable[[Key[Array, ""], Observation], PyTree]
    """key, an example observation ``[B, ...]`` -> parameters. Consumes the key."""
    apply: Callable[[PyTree, Observation], PyTree]
    """parameters, observation ``[B, ...]`` -> outputs: ``[B, A]`` for Q-values, ``([B, P], [B])`` for a policy and a value. One with memory
    answers as at the beginning of an episode."""
    recurrence: Recurrence | None = None
    layers: Callable[[PyTree, Observation], PyTree] | None = None
    """parameters, observation -> what the hidden layers put out (``hidden_layers.py``); None of a network that does not say."""
    modules: Callable[[PyTree], PyTree] = _as_it_is
    """parameters, or anything shaped like them -> a tree whose first names are the network's modules."""


NetworkBuilder: TypeAlias = Callable[[EnvSpec, int], Network]
"""spec, number of outputs -> Network: the form in which a user's own network is given."""


def fresh_memory(network: Network, batch: int) -> PyTree:
    """The memory an episode begins with; ``()`` of a network without."""
    return () if network.recurrence is None else network.recurrence.fresh(batch)


def apply_step(network: Network, params: PyTree, memory: PyTree, obs: Observation) -> tuple[PyTree, PyTree]:
    """One decision: memory, outputs."""
    if network.recurrence is None:
        return memory, network.apply(params, obs)
    return network.recurrence.step(params, memory, obs)


def begins_episode(rollout: Rollout) -> Bool[Array, "T B"]:
    """Which steps of a rollout are the first of their episode; of the first row, the rollout's own memory knows."""
    ended = rollout.step.done | ~rollout.step.valid
    return jnp.concatenate([jnp.zeros_like(ended[:1]), ended[:-1]])


def apply_rollout(network: Network, params: PyTree, rollout: Rollout) -> tuple[PyTree, PyTree]:
    """Outputs ``[T, B, ...]`` at every observation of a rollout, and at the true successor of every action.

    One pass over both for a network without memory: large batches are cheap, and no boundary needs a special case.
    """
    length, num_envs = rollout.step.reward.shape
    successors = as_rows(rollout.step.next_obs)

    def as_time(x: Array) -> Array:
        return x.reshape((length, num_envs, *x.shape[1:]))

    if network.recurrence is None:
        both = jax.tree.map(lambda now, then: jnp.concatenate([now, then]), as_rows(rollout.obs), successors)
        outputs = network.apply(params, both)
        half = length * num_envs
        return jax.tree.map(lambda x: as_time(x[:half]), outputs), jax.tree.map(lambda x: as_time(x[half:]), outputs)
    memories, outputs = network.recurrence.unroll(params, rollout.memory, rollout.obs, begins_episode(rollout))
    _, following = network.recurrence.step(params, as_rows(memories), successors)
    return outputs, jax.tree.map(as_time, following)


def rollout_values(network: Network, params: PyTree, rollout: Rollout) -> tuple[Float[Array, "T B"], Float[Array, "T B"]]:
    """Values at every observation of a rollout, and at the true successor of every action that did not terminate. No gradient.

    ``network`` gives a policy and a value. The successor of most steps is the next observation, whose value is known; without a memory,
    only successors that a limit cut off are looked at again, some at a time (a pass over all of them is 4 % of PPO on CartPole).
    """
    if network.recurrence is not None:
        (_, value), (_, next_value) = apply_rollout(network, params, rollout)
        return value, next_value
    step = rollout.step
    length, num_envs = step.reward.shape
    rows = length * num_envs
    successors, last = as_rows(step.next_obs), jax.tree.map(lambda x: x[-1], step.next_obs)
    _, flat = network.apply(params, jax.tree.map(lambda now, then: jnp.concatenate([now, then]), as_rows(rollout.obs), last))
    at_once = max(num_envs, rows // 32)

    def look(found: tuple[Array, Array]) -> tuple[Array, Array]:
        known, unknown = found
        (some,) = jnp.nonzero(unknown, size=at_once, fill_value=rows)
        _, values = network.apply(params, jax.tree.map(lambda x: x[some], successors))
        return known.at[some].set(values, mode="drop"), unknown.at[some].set(False, mode="drop")

    # Of the last row the successor itself has been valued.
    cut = (step.truncated & ~step.terminated).reshape(-1) & (jnp.arange(rows) < rows - num_envs)
    next_value, _ = jax.lax.while_loop(lambda found: jnp.any(found[1]), look, (flat[num_envs:], cut))
    return flat[:rows].reshape(length, num_envs), next_value.reshape(length, num_envs)


def with_outputs(network: Network, change: Callable[[PyTree, Observation], PyTree]) -> Network:
    """The same network with its outputs changed: ``change(outputs, obs)``."""

    def apply(params: PyTree, obs: Observation) -> PyTree:
        return change(network.apply(params, obs), obs)

    if network.recurrence is None:
        return network._replace(apply=apply)
    inner = network.recurrence

    def step(params: PyTree, memory: PyTree, obs: Observation) -> tuple[PyTree, PyTree]:
        memory, outputs = inner.step(params, memory, obs)
        return memory, change(outputs, obs)

    def unroll(params: PyTree, memory: PyTree, obs: Observation, begins: Bool[Array, "T B"]) -> tuple[PyTree, PyTree]:
        memories, outputs = inner.unroll(params, memory, obs, begins)
        return memories, change(outputs, obs)

    return network._replace(apply=apply, recurrence=Recurrence(inner.fresh, step, unroll))


def as_rows(tree: PyTree) -> PyTree:
    """Leaves ``[T, B, ...]`` as ``[T * B, ...]``."""
    return jax.tree.map(lambda x: x.reshape((-1, *x.shape[2:])), tree)


def flattened(network: Network, example: Observation) -> Network:
    """The same network with its parameters as one flat vector; ``init`` still gives them as they are."""
    template = jax.eval_shape(network.init, jax.random.key(0), example)
    _, unravel = ravel_pytree(jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), template))

    def apply(flat: Array, obs: Observation) -> PyTree:
        return network.apply(unravel(flat), obs)

    look = network.layers
    layers = None if look is None else lambda flat, obs: look(unravel(flat), obs)
    plain = Network(network.init, apply, layers=layers, modules=lambda flat: network.modules(unravel(flat)))
    if network.recurrence is None:
        return plain
    fresh, step, unroll = network.recurrence
    return plain._replace(
        recurrence=Recurrence(
            fresh,
            lambda flat, memory, obs: step(unravel(flat), memory, obs),
            lambda flat, memory, obs, begins: unroll(unravel(flat), memory, obs, begins),
        )
    )
