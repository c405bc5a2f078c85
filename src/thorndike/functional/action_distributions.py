"""Action distributions as pure functions of their parameters, one a kind of action space.

A network gives parameters ``[B, P]``; noise is drawn ahead of time, so that sampling inside a scan draws nothing.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, Shaped

from thorndike.errors import UserError


class ActionDistribution(NamedTuple):
    """A family of distributions over actions. ``P`` is the number of parameters."""

    network_outputs: int
    """How many of the parameters the network computes from the observation."""
    free_parameters: int
    """How many are learnt but do not depend on the observation (a Gaussian's log standard deviations); appended to the network's."""
    draw: Callable[[Key[Array, ""], tuple[int, ...]], Float[Array, "..."]]
    """key, leading shape -> noise. Consumes the key."""
    sample: Callable[[Float[Array, "*B P"], Float[Array, "..."]], Shaped[Array, "..."]]
    """parameters, noise -> action."""
    mode: Callable[[Float[Array, "*B P"]], Shaped[Array, "..."]]
    """The most probable action."""
    log_prob: Callable[[Float[Array, "*B P"], Shaped[Array, "..."]], Float[Array, "*B"]]
    entropy: Callable[[Float[Array, "*B P"]], Float[Array, "*B"]]


def action_distribution(space: gymnasium.Space) -> ActionDistribution:
    """The usual distribution for a space: categorical, several categoricals (MultiBinary: of two), or a diagonal Gaussian.

    Raises ``UserError`` for a space that has none.
    """
    if isinstance(space, gymnasium.spaces.Discrete):
        return categorical(int(space.n))
    if isinstance(space, gymnasium.spaces.MultiDiscrete) and space.nvec.ndim == 1:
        return multi_categorical(tuple(int(n) for n in space.nvec))
    if isinstance(space, gymnasium.spaces.MultiBinary) and len(space.shape) == 1:
        return multi_categorical((2,) * space.shape[0])
    if isinstance(space, gymnasium.spaces.Box) and len(space.shape) == 1 and np.issubdtype(space.dtype, np.floating):
        return diagonal_gaussian(space.shape[0])
    raise UserError(
        f"actions may be Discrete, MultiDiscrete or MultiBinary (one row), or Box (one row of floats); this environment has {space}"
    )


def saturation(space: gymnasium.Space, action: Shaped[Array, "..."]) -> dict[str, Float[Array, ""]]:
    """``rollout/action_saturation``: the share of a Box's action numbers within 1 % of the bounds [-1, 1], or clipped to them.

    Near 1 the policy pushes against its bounds all the time. Nothing for other spaces.
    """
    if not isinstance(space, gymnasium.spaces.Box):
        return {}
    return {"rollout/action_saturation": jnp.mean((jnp.abs(action) > 0.99).astype(jnp.float32))}


def categorical(n: int) -> ActionDistribution:
    """One of ``n`` actions; the parameters are logits, the noise is Gumbel."""

    def log_prob(logits: Float[Array, "*B n"], action: Shaped[Array, "*B"]) -> Float[Array, "*B"]:
        # A one-hot product, because its gradient is a product too: the gradient of a gather is a scatter, slow on a CPU.
        chosen = jax.nn.one_hot(action, n, dtype=logits.dtype)
        return jnp.sum(jax.nn.log_softmax(logits) * chosen, axis=-1)

    def entropy(logits: Float[Array, "*B n"]) -> Float[Array, "*B"]:
        log_probabilities = jax.nn.log_softmax(logits)
        return -jnp.sum(jnp.exp(log_probabilities) * log_probabilities, axis=-1)

    return ActionDistribution(
        network_outputs=n,
        free_parameters=0,
        draw=lambda key, shape: jax.random.gumbel(key, (*shape, n)),
        sample=lambda logits, noise: jnp.argmax(logits + noise, axis=-1).astype(jnp.int32),
        mode=lambda logits: jnp.argmax(logits, axis=-1).astype(jnp.int32),
        log_prob=log_prob,
        entropy=entropy,
    )


def multi_categorical(sizes: tuple[int, ...]) -> ActionDistribution:
    """Independent categoricals of the given sizes; actions are ``int32[*B, K]``."""
    parts = [categorical(n) for n in sizes]
    ends = tuple(int(end) for end in np.cumsum(sizes)[:-1])

    def split(x: Float[Array, "*B P"]) -> list[Float[Array, "*B n"]]:
        return jnp.split(x, ends, axis=-1)

    return ActionDistribution(
        network_outputs=sum(sizes),
        free_parameters=0,
        draw=lambda key, shape: jax.random.gumbel(key, (*shape, sum(sizes))),
        sample=lambda logits, noise: jnp.stack([p.sample(x, g) for p, x, g in zip(parts, split(logits), split(noise), strict=True)], -1),
        mode=lambda logits: jnp.stack([p.mode(x) for p, x in zip(parts, split(logits), strict=True)], -1),
        log_prob=lambda logits, action: sum(
            (p.log_prob(x, action[..., i]) for i, (p, x) in enumerate(zip(parts, split(logits), strict=True))), jnp.zeros(())
        ),
        entropy=lambda logits: sum((p.entropy(x) for p, x in zip(parts, split(logits), strict=True)), jnp.zeros(())),
    )


def diagonal_gaussian(dimensions: int) -> ActionDistribution:
    """Independent Gaussians; parameters are the means and the log standard deviations. Actions are not squashed: the engine clips them."""

    def split(parameters: Float[Array, "*B P"]) -> tuple[Float[Array, "*B D"], Float[Array, "*B D"]]:
        return parameters[..., :dimensions], parameters[..., dimensions:]

    def sample(parameters: Float[Array, "*B P"], noise: Float[Array, "*B D"]) -> Float[Array, "*B D"]:
        mean, log_std = split(parameters)
        return mean + jnp.exp(log_std) * noise

    def log_prob(parameters: Float[Array, "*B P"], action: Float[Array, "*B D"]) -> Float[Array, "*B"]:
        mean, log_std = split(parameters)
        standard = (action - mean) * jnp.exp(-log_std)
        return jnp.sum(-0.5 * jnp.square(standard) - log_std - 0.5 * math.log(2.0 * math.pi), axis=-1)

    return ActionDistribution(
        network_outputs=dimensions,
        free_parameters=dimensions,
        draw=lambda key, shape: jax.random.normal(key, (*shape, dimensions)),
        sample=sample,
        mode=lambda parameters: split(parameters)[0],
        log_prob=log_prob,
        entropy=lambda parameters: jnp.sum(split(parameters)[1] + 0.5 * math.log(2.0 * math.pi * math.e), axis=-1),
    )
