"""One step of gradient descent on parameters that travel with their optimiser's state."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, PyTree

from thorndike.types import Metrics, Number


class Optimized(NamedTuple):
    """Parameters as one array (``[P]``, ``[K, P]`` of an ensemble, or a scalar) and the state of their optimiser."""

    params: Float[Array, "..."]
    opt_state: PyTree


def optimized(params: Float[Array, "..."], optimizer: optax.GradientTransformation) -> Optimized:
    """Parameters before their first step."""
    return Optimized(params, optimizer.init(params))


def descend(
    optimizer: optax.GradientTransformation, rate: Number, held: Optimized, gradient: Float[Array, "..."]
) -> tuple[Optimized, Float[Array, ""]]:
    """The parameters after a step of size ``rate`` along the optimiser's direction, and the norm of the gradient."""
    direction, opt_state = optimizer.update(gradient, held.opt_state)
    return Optimized(held.params - rate * direction, opt_state), jnp.sqrt(jnp.sum(jnp.square(gradient)))


def follow(target: Float[Array, "..."], params: Float[Array, "..."], tau: Number) -> Float[Array, "..."]:
    """A target moved towards the parameters: ``target + tau (params - target)`` (Lillicrap et al. 2016, arXiv:1509.02971, algorithm 1)."""
    return target + tau * (params - target)


def every(times: int, number: Int[Array, ""], update: Callable[[PyTree], tuple[PyTree, Metrics]], held: PyTree) -> tuple[PyTree, Metrics]:
    """``update(held)`` once in ``times`` calls, counted by ``number``; else ``held`` as it is and metrics of 0.

    The metrics are multiplied by ``times``, so that their mean over all updates is that of the calls that updated.
    """
    if times == 1:
        return update(held)
    shapes = jax.eval_shape(update, held)[1]

    def scaled(held: PyTree) -> tuple[PyTree, Metrics]:
        after, metrics = update(held)
        return after, jax.tree.map(lambda x: x * times, metrics)

    def wait(held: PyTree) -> tuple[PyTree, Metrics]:
        return held, jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)

    # A branch, because the update is half of the work; what it carries is small, and the replay is not part of it.
    return jax.lax.cond(number % times == times - 1, scaled, wait, held)
