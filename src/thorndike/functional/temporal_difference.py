"""One-step targets of temporal-difference learning, for tables and for networks alike.

Everywhere `terminated` means that the task ended, so that the future is worth 0. A time limit is no termination: there the caller passes
``terminated = False`` and the values of the true successor ``Step.next_obs``, never those of the observation after the reset.
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Num

from thorndike.types import Number


def bootstrap(
    reward: Float[Array, "*batch"], terminated: Bool[Array, "*batch"], next_value: Float[Array, "*batch"], gamma: Number
) -> Float[Array, "*batch"]:
    """Reward plus the discounted value of the successor, which is 0 where the task ended: ``r + gamma * (1 - terminated) * v'``."""
    return reward + gamma * jnp.where(terminated, 0.0, next_value)


def q_learning_target(
    reward: Float[Array, "*batch"], terminated: Bool[Array, "*batch"], next_q: Float[Array, "*batch actions"], gamma: Number
) -> Float[Array, "*batch"]:
    """``r + gamma * max_a Q(s', a)`` (Watkins 1989; Sutton and Barto 2018, equation 6.8)."""
    return bootstrap(reward, terminated, next_q.max(axis=-1), gamma)


def sarsa_target(
    reward: Float[Array, "*batch"],
    terminated: Bool[Array, "*batch"],
    next_q: Float[Array, "*batch actions"],
    next_action: Int[Array, "*batch"],
    gamma: Number,
) -> Float[Array, "*batch"]:
    """``r + gamma * Q(s', a')`` with the action taken next (Rummery and Niranjan 1994; Sutton and Barto 2018, equation 6.7)."""
    return bootstrap(reward, terminated, select(next_q, next_action), gamma)


def expected_sarsa_target(
    reward: Float[Array, "*batch"],
    terminated: Bool[Array, "*batch"],
    next_q: Float[Array, "*batch actions"],
    epsilon: Float[Array, "*batch"],
    gamma: Number,
) -> Float[Array, "*batch"]:
    """``r + gamma * E Q(s', .)`` under the epsilon-greedy policy (van Seijen et al. 2009; Sutton and Barto 2018, equation 6.9)."""
    expected = (1.0 - epsilon) * next_q.max(axis=-1) + epsilon * next_q.mean(axis=-1)
    return bootstrap(reward, terminated, expected, gamma)


def double_q_target(
    reward: Float[Array, "*batch"],
    terminated: Bool[Array, "*batch"],
    next_q_select: Float[Array, "*batch actions"],
    next_q_evaluate: Float[Array, "*batch actions"],
    gamma: Number,
) -> Float[Array, "*batch"]:
    """``r + gamma * Q_b(s', argmax_a Q_a(s', a))``: one table chooses, the other evaluates (van Hasselt 2010; arXiv:1509.06461)."""
    return bootstrap(reward, terminated, select(next_q_evaluate, next_q_select.argmax(axis=-1)), gamma)


def select(q: Num[Array, "*batch actions"], action: Int[Array, "*batch"]) -> Num[Array, "*batch"]:
    """The value of one action a row: ``q[..., action]``."""
    # A masked sum, not a gather: in a compiled CPU loop it fuses with its neighbours and stays free of bounds checks.
    chosen = lax.broadcasted_iota(action.dtype, q.shape, q.ndim - 1) == jnp.expand_dims(action, -1)
    return jnp.where(chosen, q, jnp.zeros((), q.dtype)).sum(axis=-1, dtype=q.dtype)
