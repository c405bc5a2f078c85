"""Returns and advantages over time-major ``[T, B]`` arrays, with termination and truncation kept apart."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from thorndike.types import Number


def discounted_returns(
    reward: Float[Array, "T *B"], done: Bool[Array, "T *B"], bootstrap: Float[Array, "T *B"], gamma: Number
) -> Float[Array, "T *B"]:
    """Discounted return of every step, restarted where an episode ended.

    ``bootstrap`` is the value the return continues with after a step that ends an episode or the rollout (0 after a termination). Sutton
    and Barto 2018, eq. 3.9.
    """

    def backward(following: Float[Array, "*B"], row: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        reward_t, done_t, bootstrap_t = row
        current = reward_t + gamma * jnp.where(done_t, bootstrap_t, following)
        return current, current

    _, returns = jax.lax.scan(backward, bootstrap[-1], (reward, done, bootstrap), reverse=True, unroll=8)
    return returns


def generalized_advantage(
    reward: Float[Array, "T *B"],
    value: Float[Array, "T *B"],
    next_value: Float[Array, "T *B"],
    terminated: Bool[Array, "T *B"],
    done: Bool[Array, "T *B"],
    gamma: Number,
    gae_lambda: Number,
    turn: Float[Array, "T *B"] | float = 1.0,
) -> Float[Array, "T *B"]:
    """Generalised advantage estimates.

    ``next_value`` is the value of the *true* successor of each step, so that a time limit bootstraps from the observation the episode was
    cut at: only ``terminated`` removes it, and ``done`` stops the sum. Schulman et al. 2016 (arXiv:1506.02438), eq. 16.

    In a game of two, ``reward`` and ``value`` are those of whoever moves, and ``turn`` is -1 where the successor is seen from the other
    side, 1 where the same player moves again: what is good for one is bad for the other, along the whole sum.
    """
    delta = reward + gamma * turn * jnp.where(terminated, 0.0, next_value) - value
    carry_on = jnp.where(done, 0.0, gamma * gae_lambda * turn)

    def backward(following: Float[Array, "*B"], row: tuple[Array, Array]) -> tuple[Array, Array]:
        delta_t, carry_on_t = row
        current = delta_t + carry_on_t * following
        return current, current

    _, advantage = jax.lax.scan(backward, jnp.zeros_like(delta[0]), (delta, carry_on), reverse=True, unroll=8)
    return advantage


def n_step_return(
    reward: Float[Array, "n *B"], terminated: Bool[Array, "n *B"], done: Bool[Array, "n *B"], gamma: Number
) -> tuple[Float[Array, "*B"], Float[Array, "*B"], Array]:
    """Sum of up to ``n`` discounted rewards that stops where the episode ends.

    Returns the sum, the discount to put before the bootstrap value (0 after a termination) and the index ``int32[*B]`` of the last row
    used, whose successor is bootstrapped from. Sutton 1988; Hessel et al. 2018 (arXiv:1710.02298), section 3.
    """
    n = reward.shape[0]
    ended_before = jnp.concatenate([jnp.zeros_like(done[:1]), jnp.cumsum(done[:-1], axis=0) > 0])
    alive = ~ended_before
    powers = (gamma ** jnp.arange(n, dtype=reward.dtype)).reshape((n,) + (1,) * (reward.ndim - 1))
    total = jnp.sum(jnp.where(alive, powers * reward, 0.0), axis=0)
    last = jnp.sum(alive, axis=0, dtype=jnp.int32) - 1
    discount = gamma ** (last + 1).astype(reward.dtype)
    return total, jnp.where(jnp.any(alive & terminated, axis=0), 0.0, discount), last


def lambda_return(
    reward: Float[Array, "T *B"],
    next_value: Float[Array, "T *B"],
    terminated: Bool[Array, "T *B"],
    done: Bool[Array, "T *B"],
    gamma: Number,
    trace_decay: Number,
) -> Float[Array, "T *B"]:
    """``G_t = r_t + gamma ((1 - lambda) v(s_t+1) + lambda G_t+1)``; where an episode or the rollout ends, the value alone.

    ``next_value`` is the value of the *true* successor of each step; only ``terminated`` removes it. With the best action's value this is
    Peng's Q(lambda), which does not stop at exploring actions. Sutton and Barto 2018, eq. 12.18; Peng and Williams 1996.
    """

    def backward(following: Float[Array, "*B"], row: tuple[Array, Array, Array, Array]) -> tuple[Array, Array]:
        reward_t, value_t, terminated_t, done_t = row
        mixed = jnp.where(done_t, value_t, value_t + trace_decay * (following - value_t))
        current = reward_t + gamma * jnp.where(terminated_t, 0.0, mixed)
        return current, current

    _, returns = jax.lax.scan(backward, next_value[-1], (reward, next_value, terminated, done), reverse=True, unroll=8)
    return returns
