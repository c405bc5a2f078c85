"""One step of gradient descent on parameters that travel with their optimiser's state."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, PyTree

from thorndike.functional.guards import accept_if, all_finite
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


class Averaged(NamedTuple):
    """Parameters of any form, the running average of them, and the state of their optimiser."""

    params: PyTree
    average: PyTree
    opt_state: PyTree


def clipped_adamw(max_grad_norm: Number, weight_decay: Number) -> optax.GradientTransformation:
    """Adam with decoupled weight decay, the gradient's global norm clipped before."""
    return optax.chain(optax.clip_by_global_norm(max_grad_norm), optax.scale_by_adam(), optax.add_decayed_weights(weight_decay))


def averaged(params: PyTree, optimizer: optax.GradientTransformation) -> Averaged:
    """Parameters before their first step."""
    return Averaged(params, jax.tree.map(jnp.copy, params), optimizer.init(params))


def descend_averaged(
    optimizer: optax.GradientTransformation, rate: Number, averaging: Number, held: Averaged, gradient: PyTree, loss: Float[Array, ""]
) -> tuple[Averaged, Float[Array, ""]]:
    """The parameters after a step of size ``rate``, their average moved to them by ``averaging``, and the norm of the gradient.

    All stays as it was where that norm or the loss is not a number.
    """
    direction, opt_state = optimizer.update(gradient, held.opt_state, held.params)
    params = jax.tree.map(lambda p, d: p - rate * d, held.params, direction)
    average = jax.tree.map(lambda a, p: a + averaging * (p - a), held.average, params)
    norm = optax.tree.norm(gradient)
    return accept_if(all_finite(loss, norm), Averaged(params, average, opt_state), held), norm


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
