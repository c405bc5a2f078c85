"""Sequences from a ring as a learnt model is taught by them: one observation, ``K`` actions from there, and what followed."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from thorndike.functional.unrolled_targets import UnrolledTargets, unrolled_targets
from thorndike.networks.network import as_rows
from thorndike.replay.uniform import ReplayBuffer
from thorndike.types import Number, Observation


class Unrolled(NamedTuple):
    """``M`` sequences of ``L = K + n`` steps, time-major."""

    obs: Observation
    """The first one ``[M, ...]``."""
    action: Int[Array, "K M"]
    policy: Float[Array, "K1 M actions"]
    """What a search made of 0 to K steps."""
    reward: Float[Array, "L M"]
    terminated: Bool[Array, "L M"]
    done: Bool[Array, "L M"]
    value: Float[Array, "L M"]
    """What a search found the next row's observation to be worth: another episode's, where one ended."""
    end_obs: Observation
    """The true successor of the first step that ends an episode, else of the last step ``[M, ...]``."""
    later_obs: Observation
    """What the last ``K + 1`` entries of ``value`` are of, ``[K + 1, M, ...]``; ``()`` if nobody asked."""
    valid: Float[Array, " M"]
    """0 for a sequence that begins with a row that is no transition."""


def unrolled_at(buffer: ReplayBuffer, first: Int[Array, " M"], num_envs: int, unroll: int, n_step: int, again: bool = False) -> Unrolled:
    """The sequences that begin at these rows, whose next ``K + n`` steps must be stored: draw with ``follow = K + n + 1``.

    ``again``: with the observations whose values are bootstrapped from, for somebody to value them again.
    """
    rows, length = buffer.rows, unroll + n_step
    total = jax.tree.leaves(rows)[0].shape[0]
    window = (first[None, :] + num_envs * jnp.arange(length + 1, dtype=jnp.int32)[:, None]) % total
    steps, done = window[:-1], rows["done"][window[:-1]]
    end = jnp.where(jnp.any(done, axis=0), jnp.argmax(done, axis=0), length - 1).astype(jnp.int32)
    ending = (first + num_envs * end) % total
    return Unrolled(
        obs=jax.tree.map(lambda x: x[first], rows["obs"]),
        action=rows["action"][window[:unroll]],
        policy=rows["search"]["policy"][window[: unroll + 1]],
        reward=rows["reward"][steps],
        terminated=rows["terminated"][steps],
        done=done,
        value=rows["search"]["value"][window[1:]],
        end_obs=jax.tree.map(lambda x: x[ending], rows["next_obs"]),
        later_obs=jax.tree.map(lambda x: x[window[n_step:]], rows["obs"]) if again else (),
        valid=rows["valid"][first].astype(jnp.float32),
    )


def targets_of(batch: Unrolled, worth: Callable[[Observation], Float[Array, " rows"]], discount: Number, n_step: int) -> UnrolledTargets:
    """What a model is taught by sequences; ``worth`` values observations now, where an episode was cut and wherever it is asked to."""
    following = batch.value
    if jax.tree.leaves(batch.later_obs):
        fresh = worth(as_rows(batch.later_obs)).reshape(batch.policy.shape[:2])
        following = jnp.concatenate([following[: n_step - 1], fresh])
    # Where an episode was cut, what followed in the ring is another one.
    next_value = jnp.where(batch.done, worth(batch.end_obs), following)
    return unrolled_targets(batch.reward, next_value, batch.terminated, batch.done, discount, n_step)
