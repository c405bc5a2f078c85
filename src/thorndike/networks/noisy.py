"""Noisy layers: every dense layer's weights have a mean and a learnt spread, and acting and learning see a draw of them.

Fortunato et al. 2018, "Noisy Networks for Exploration" (arXiv:1706.10295), factorised Gaussian noise (section 3.b). Here the noise is put
on the weights before the network is applied, so that any network can have it; one draw serves a whole batch, as in the paper's DQN.
Convolutions have no noise.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from thorndike.types import Number


class Noise(NamedTuple):
    """The noise of a network's parameters."""

    size: int
    """How many random numbers one draw takes: inputs and outputs of every dense layer."""
    spread: PyTree
    """What the spread of each weight begins with, a tree like the parameters."""
    shaped: Callable[[Float[Array, " size"]], PyTree]
    """Standard normal numbers -> the noise of each weight, before its spread."""


class _Dense(NamedTuple):
    start: int
    inputs: int
    outputs: int


def noise_of(params: PyTree, sigma: Number) -> Noise:
    """The noise for parameters of this form (shapes are enough); spreads begin at ``sigma / sqrt(inputs)``: section 3.2."""
    layers: dict[str, _Dense] = {}
    size = 0
    for path, leaf in jax.tree.leaves_with_path(params):
        if _name(path) == "kernel" and len(leaf.shape) == 2:
            layers[_layer(path)] = _Dense(size, *leaf.shape)
            size += sum(leaf.shape)

    def spread(path: tuple, leaf: Array | jax.ShapeDtypeStruct) -> Array:
        layer = layers.get(_layer(path))
        return jnp.full(leaf.shape, 0.0 if layer is None else sigma / layer.inputs**0.5, jnp.float32)

    def shaped(noise: Float[Array, " size"]) -> PyTree:
        squashed = jnp.sign(noise) * jnp.sqrt(jnp.abs(noise))

        def of_leaf(path: tuple, leaf: Array | jax.ShapeDtypeStruct) -> Array:
            layer = layers.get(_layer(path))
            if layer is None:
                return jnp.zeros(leaf.shape)
            middle = layer.start + layer.inputs
            outputs = squashed[middle : middle + layer.outputs]
            return squashed[layer.start : middle, None] * outputs[None, :] if _name(path) == "kernel" else outputs

        return jax.tree_util.tree_map_with_path(of_leaf, params)

    return Noise(size, jax.tree_util.tree_map_with_path(spread, params), shaped)


def _name(path: tuple) -> str:
    return str(getattr(path[-1], "key", ""))


def _layer(path: tuple) -> str:
    return jax.tree_util.keystr(path[:-1])
