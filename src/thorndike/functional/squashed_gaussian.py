"""A diagonal Gaussian squashed into (-1, 1) by the hyperbolic tangent: the policy of SAC and its relatives.

Haarnoja et al. 2018 (arXiv:1801.01290), appendix C. Parameters ``[*B, 2 D]`` are the means and the log standard deviations before the
squashing; the latter are clipped to [-20, 2].
"""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

LOG_STD_MIN, LOG_STD_MAX = -20.0, 2.0


def sample_squashed(parameters: Float[Array, "*B P"], noise: Float[Array, "*B D"]) -> tuple[Float[Array, "*B D"], Float[Array, "*B"]]:
    """Action in (-1, 1) and its log-probability, from standard normal ``noise``; differentiable in the parameters.

    ``log(1 - tanh(u)^2)`` is written ``2 (log 2 - u - softplus(-2 u))``, which stays exact where tanh rounds to 1.
    """
    mean, log_std = _split(parameters)
    before = mean + jnp.exp(log_std) * noise
    shrinking = 2.0 * (math.log(2.0) - before - jax.nn.softplus(-2.0 * before))
    density = -0.5 * jnp.square(noise) - log_std - 0.5 * math.log(2.0 * math.pi)
    return jnp.tanh(before), jnp.sum(density - shrinking, axis=-1)


def squashed_mode(parameters: Float[Array, "*B P"]) -> Float[Array, "*B D"]:
    """The action of the mean: what SAC is evaluated with."""
    return jnp.tanh(_split(parameters)[0])


def _split(parameters: Float[Array, "*B P"]) -> tuple[Float[Array, "*B D"], Float[Array, "*B D"]]:
    mean, log_std = jnp.split(parameters, 2, axis=-1)
    return mean, jnp.clip(log_std, LOG_STD_MIN, LOG_STD_MAX)
