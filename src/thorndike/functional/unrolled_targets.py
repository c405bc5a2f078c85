"""What a learnt model should say at each of ``K`` steps into the future, from what happened and what a search found there.

Schrittwieser et al. 2020, MuZero (arXiv:1911.08265), eq. 1 and appendix G. Arrays are time-major ``[T, M]``.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from thorndike.functional.returns import n_step_return
from thorndike.types import Number


class UnrolledTargets(NamedTuple):
    """Targets of ``K`` steps, and which of them count (0 or 1)."""

    value: Float[Array, "K1 M"]
    """Of the state after 0 to K steps."""
    reward: Float[Array, "K M"]
    """Of the step that leads to each state but the first."""
    known: Float[Array, "K1 M"]
    """1 up to a limit that cut the episode: what lies behind it nobody saw. Beyond a termination all is known: no value, no reward."""
    alive: Float[Array, "K1 M"]
    """1 where somebody decided: up to the end of the episode."""


def unrolled_targets(
    reward: Float[Array, "L M"],
    next_value: Float[Array, "L M"],
    terminated: Bool[Array, "L M"],
    done: Bool[Array, "L M"],
    discount: Number,
    n_step: int,
) -> UnrolledTargets:
    """Targets from ``L = K + n_step`` steps in a row, of which the first may not lie beyond the end of an episode.

    ``next_value`` is the value of the true successor of each step. A value is the sum of ``n_step`` discounted rewards and the value of
    where they lead. In a game of two who take turns the discount is negative.
    """
    starts = jnp.arange(reward.shape[0] - n_step + 1)
    window = jnp.arange(n_step)[:, None] + starts[None, :]
    total, factor, last = n_step_return(reward[window], terminated[window], done[window], discount)
    bootstrap = jnp.take_along_axis(next_value, starts[:, None] + last, axis=0)
    count = starts.shape[0]
    ended = _before(done, count)
    first_end = done & ~_before(done, done.shape[0])
    died = _before(first_end & terminated, count)
    return UnrolledTargets(
        value=jnp.where(ended, 0.0, total + factor * bootstrap),
        reward=jnp.where(ended, 0.0, reward[:count])[:-1],
        known=(~ended | died).astype(jnp.float32),
        alive=(~ended).astype(jnp.float32),
    )


def _before(flag: Bool[Array, "L M"], count: int) -> Bool[Array, "C M"]:
    """Whether it was so at any earlier step, for the first ``count`` steps."""
    counted = jnp.cumsum(flag, axis=0, dtype=jnp.int32)
    return jnp.concatenate([jnp.zeros_like(flag[:1]), counted[:-1] > 0])[:count]


def scaled_gradient(x: Float[Array, "*B"], factor: float) -> Float[Array, "*B"]:
    """``x`` as it is, whose gradient is multiplied by ``factor``."""
    return factor * x + (1.0 - factor) * jax.lax.stop_gradient(x)
