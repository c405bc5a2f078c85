"""How far one policy is from another: Kullback-Leibler divergences of the usual action distributions, in closed form."""

from collections.abc import Callable

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thorndike.errors import UserError

Divergence = Callable[[Float[Array, "*B P"], Float[Array, "*B P"]], Float[Array, "*B"]]
"""Parameters of two policies, as ``action_distribution`` of the same space takes them -> KL(first || second)."""


def policy_divergence(space: gymnasium.Space) -> Divergence:
    """The divergence of the distribution that ``action_distribution`` gives a space. Raises ``UserError`` for a space that has none."""
    if isinstance(space, gymnasium.spaces.Discrete):
        return categorical_divergence
    if isinstance(space, gymnasium.spaces.MultiDiscrete) and space.nvec.ndim == 1:
        return _of_parts(tuple(int(n) for n in space.nvec))
    if isinstance(space, gymnasium.spaces.MultiBinary) and len(space.shape) == 1:
        return _of_parts((2,) * space.shape[0])
    if isinstance(space, gymnasium.spaces.Box) and len(space.shape) == 1:
        return gaussian_divergence
    raise UserError(f"a trust region needs Discrete, MultiDiscrete, MultiBinary or Box actions in one row; this environment has {space}")


def categorical_divergence(first: Float[Array, "*B n"], second: Float[Array, "*B n"]) -> Float[Array, "*B"]:
    """``sum p (log p - log q)`` of two rows of logits. What is masked in both adds nothing."""
    log_first, log_second = jax.nn.log_softmax(first), jax.nn.log_softmax(second)
    return jnp.sum(jnp.exp(log_first) * (log_first - log_second), axis=-1)


def gaussian_divergence(first: Float[Array, "*B P"], second: Float[Array, "*B P"]) -> Float[Array, "*B"]:
    """Of two diagonal Gaussians, given as means and log standard deviations side by side."""
    mean_first, log_first = jnp.split(first, 2, axis=-1)
    mean_second, log_second = jnp.split(second, 2, axis=-1)
    spread = 0.5 * jnp.exp(2.0 * (log_first - log_second))
    distance = 0.5 * jnp.square((mean_first - mean_second) * jnp.exp(-log_second))
    return jnp.sum(log_second - log_first + spread + distance - 0.5, axis=-1)


def _of_parts(sizes: tuple[int, ...]) -> Divergence:
    """The sum over independent categoricals."""
    ends = tuple(int(end) for end in np.cumsum(sizes)[:-1])

    def total(first: Float[Array, "*B P"], second: Float[Array, "*B P"]) -> Float[Array, "*B"]:
        pairs = zip(jnp.split(first, ends, axis=-1), jnp.split(second, ends, axis=-1), strict=True)
        return sum((categorical_divergence(p, q) for p, q in pairs), jnp.zeros(()))

    return total
