"""A multilayer perceptron whose input and hidden layers are batch-renormalised: what CrossQ learns with in place of target networks.

Ioffe 2017, "Batch Renormalization" (arXiv:1702.03275); as in Bhatt et al. 2024 (arXiv:1902.05605).
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Key, PyTree

from thorndike.networks.hidden_layers import SHOWN, look_into_ensemble
from thorndike.networks.torso import ACTIVATIONS, torch_uniform
from thorndike.types import Metrics, Number

MOMENTUM, EPSILON = 0.99, 1e-3
MAX_RATIO, MAX_SHIFT = 3.0, 5.0
"""How far the batch's deviation and mean may be from the running ones before the correction is clipped."""


class BatchRenorm(nn.Module):
    """Zero mean and unit variance over the batch, corrected towards the running moments once ``warmup`` batches were seen.

    With ``learning`` the moments are the batch's and the running ones move; else the running ones are used. A batch's correction gets no
    gradient. Ioffe 2017, algorithm 1.
    """

    warmup: Number | int

    @nn.compact
    def __call__(self, x: Float[Array, "B F"], learning: bool) -> Float[Array, "B F"]:
        """Rows to rows."""
        width = x.shape[-1]
        mean = self.variable("batch_stats", "mean", lambda: jnp.zeros(width))
        variance = self.variable("batch_stats", "variance", lambda: jnp.ones(width))
        seen = self.variable("batch_stats", "seen", lambda: jnp.zeros(()))
        scale = self.param("scale", nn.initializers.ones, (width,))
        bias = self.param("bias", nn.initializers.zeros, (width,))
        if not learning:
            return (x - mean.value[None]) * (scale / jnp.sqrt(variance.value + EPSILON))[None] + bias[None]
        batch_mean = jnp.mean(x, axis=0)
        batch_variance = jnp.mean(jnp.square(x - batch_mean[None]), axis=0)
        deviation, running = jnp.sqrt(batch_variance + EPSILON), jnp.sqrt(variance.value + EPSILON)
        warm = seen.value >= self.warmup
        ratio = jnp.where(warm, jnp.clip(deviation / running, 1.0 / MAX_RATIO, MAX_RATIO), 1.0)
        shift = jnp.where(warm, jnp.clip((batch_mean - mean.value) / running, -MAX_SHIFT, MAX_SHIFT), 0.0)
        ratio, shift = jax.lax.stop_gradient((ratio, shift))
        if not self.is_initializing():
            mean.value = MOMENTUM * mean.value + (1.0 - MOMENTUM) * batch_mean
            variance.value = MOMENTUM * variance.value + (1.0 - MOMENTUM) * batch_variance
            seen.value = seen.value + 1.0
        standard = (x - batch_mean[None]) * (ratio / deviation)[None] + shift[None]
        return standard * scale[None] + bias[None]


class RenormalizedMLP(nn.Module):
    """Dense layers, the input and each activation renormalised, and a dense layer to ``outputs`` numbers."""

    hidden: Sequence[int]
    activation: str
    outputs: int
    warmup: Number | int

    @nn.compact
    def __call__(self, x: Float[Array, "B F"], learning: bool) -> Float[Array, "B outputs"]:
        """Rows to outputs."""
        x = BatchRenorm(self.warmup)(x, learning)
        for width in self.hidden:
            x = ACTIVATIONS[self.activation](nn.Dense(width, kernel_init=torch_uniform)(x))
            self.sow(SHOWN, self.activation, x)
            x = BatchRenorm(self.warmup)(x, learning)
        return nn.Dense(self.outputs, kernel_init=torch_uniform)(x)


class RenormalizedNetwork(NamedTuple):
    """A network with running moments. Parameters and moments are flat vectors."""

    init: Callable[[Key[Array, ""]], tuple[Float[Array, " P"], Float[Array, " S"]]]
    """key -> parameters, moments. Consumes the key."""
    learning: Callable[[Float[Array, " P"], Float[Array, " S"], Float[Array, "M F"]], tuple[Float[Array, "M outputs"], Float[Array, " S"]]]
    """parameters, moments, rows -> outputs by the batch's own moments, the running moments after it."""
    acting: Callable[[Float[Array, " P"], Float[Array, " S"], Float[Array, "M F"]], Float[Array, "M outputs"]]
    """parameters, moments, rows -> outputs by the running moments: each row's depends on that row alone."""
    look: Callable[[str, Float[Array, "K P"], Float[Array, "K S"], Float[Array, "K P"], Float[Array, "M F"]], Metrics]
    """name, parameters and moments of ``K`` networks, their mean squared gradients, rows -> dead units, effective rank, gradient norms:
    the mean over the networks."""


def renormalized_network(inputs: int, outputs: int, hidden: Sequence[int], activation: str, warmup: Number | int) -> RenormalizedNetwork:
    """The network for rows of ``inputs`` numbers."""
    module = RenormalizedMLP(tuple(hidden), activation, outputs, warmup)
    example = jnp.zeros((1, inputs))
    template = jax.eval_shape(lambda key: module.init(key, example, True), jax.random.key(0))
    empty = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), template)
    size = ravel_pytree(empty["params"])[0].shape[0]
    of_params, of_moments = ravel_pytree(empty["params"])[1], ravel_pytree(empty["batch_stats"])[1]

    def init(key: Key[Array, ""]) -> tuple[Float[Array, " P"], Float[Array, " S"]]:
        made = module.init(key, example, True)
        return ravel_pytree(made["params"])[0], ravel_pytree(made["batch_stats"])[0]

    def learning(params: Array, moments: Array, rows: Array) -> tuple[Array, Array]:
        held = {"params": of_params(params), "batch_stats": of_moments(moments)}
        values, later = module.apply(held, rows, True, mutable=["batch_stats"])
        return values, ravel_pytree(later["batch_stats"])[0]

    def acting(params: Array, moments: Array, rows: Array) -> Array:
        return jnp.asarray(module.apply({"params": of_params(params), "batch_stats": of_moments(moments)}, rows, False))

    def look(name: str, params: Array, moments: Array, squares: Array, rows: Array) -> Metrics:
        def layers(held: Float[Array, " PS"]) -> PyTree:
            variables = {"params": of_params(held[:size]), "batch_stats": of_moments(held[size:])}
            return module.apply(variables, rows, False, mutable=[SHOWN])[1][SHOWN]

        return look_into_ensemble(name, layers, of_params, jnp.concatenate([params, moments], axis=1), squares)

    return RenormalizedNetwork(init, learning, acting, look)
