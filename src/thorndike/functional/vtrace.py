"""V-trace: values and advantages of a policy from what another, older one did.

Espeholt et al. 2018, "IMPALA: Scalable Distributed Deep-RL with Importance Weighted Actor-Learner Architectures" (arXiv:1802.01561).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from thorndike.types import Number


class VTrace(NamedTuple):
    """What the learner regresses to and follows, ``[T, B]``; neither passes a gradient on."""

    target: Float[Array, "T *B"]
    """``v_s``: what the value is regressed to (eq. 1)."""
    advantage: Float[Array, "T *B"]
    """``rho_s (r_s + gamma v_s+1 - V(x_s))``: the factor of the policy's gradient (section 4.2)."""


def vtrace(
    log_ratio: Float[Array, "T *B"],
    reward: Float[Array, "T *B"],
    value: Float[Array, "T *B"],
    next_value: Float[Array, "T *B"],
    terminated: Bool[Array, "T *B"],
    truncated: Bool[Array, "T *B"],
    valid: Bool[Array, "T *B"],
    gamma: Number,
    trace_decay: Number,
    clip_rho: Number,
    clip_c: Number,
    clip_pg_rho: Number,
) -> VTrace:
    """Off-policy targets, corrected by clipped importance weights. Espeholt et al. 2018, eq. 1 and remark 2 (``trace_decay``: lambda).

    ``log_ratio`` is ``log pi - log mu`` of the actions. ``next_value`` is the value of the *true* successor: a truncation bootstraps from
    it, a termination from 0, and no correction crosses either, or a row that is not valid, whose target is its value and advantage 0.
    """
    ratio = jnp.exp(log_ratio)
    future = jnp.where(terminated, 0.0, next_value)
    delta = jnp.where(valid, jnp.minimum(clip_rho, ratio) * (reward + gamma * future - value), 0.0)
    ends = terminated | truncated | ~valid
    carry_on = jnp.where(ends, 0.0, gamma * trace_decay * jnp.minimum(clip_c, ratio))

    def backward(following: Float[Array, "*B"], row: tuple[Array, Array]) -> tuple[Array, Array]:
        delta_t, carry_on_t = row
        current = delta_t + carry_on_t * following
        return current, current

    _, correction = jax.lax.scan(backward, jnp.zeros_like(delta[0]), (delta, carry_on), reverse=True, unroll=8)
    # v_s+1 less the value of the successor: 0 where the rollout or the episode ends.
    following = jnp.where(ends, 0.0, jnp.concatenate([correction[1:], jnp.zeros_like(correction[:1])]))
    advantage = jnp.minimum(clip_pg_rho, ratio) * (reward + gamma * (future + following) - value)
    return VTrace(*jax.lax.stop_gradient((value + correction, jnp.where(valid, advantage, 0.0))))
