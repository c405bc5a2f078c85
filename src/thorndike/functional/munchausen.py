"""Munchausen reinforcement learning: the log-policy joins the reward, and the next action is drawn softly.

Vieillard, Pietquin and Geist 2020 (arXiv:2007.14430), eq. 1: the policy is a softmax of the target network's Q-values.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from thorndike.functional.temporal_difference import select
from thorndike.types import Number


def soft_policy(q: Float[Array, "*B A"], temperature: Number) -> Float[Array, "*B A"]:
    """``softmax(Q / temperature)``."""
    return jax.nn.softmax(q / temperature, axis=-1)


def soft_bonus(q: Float[Array, "*B A"], temperature: Number) -> Float[Array, "*B"]:
    """The policy's entropy times the temperature: what it adds to the value of the state it acts in."""
    log_policy = jax.nn.log_softmax(q / temperature, axis=-1)
    return -temperature * jnp.sum(jnp.exp(log_policy) * log_policy, axis=-1)


def log_policy_reward(
    q: Float[Array, "*B A"], action: Int[Array, "*B"], alpha: Number, temperature: Number, lowest: Number
) -> Float[Array, "*B"]:
    """``alpha * clip(temperature * log policy(action), lowest, 0)``, added to the reward of that action."""
    log_policy = temperature * jax.nn.log_softmax(q / temperature, axis=-1)
    return alpha * jnp.clip(select(log_policy, action), lowest, 0.0)
