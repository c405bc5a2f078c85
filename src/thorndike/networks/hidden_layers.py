"""What the hidden layers of a network put out, beside its outputs: for ``train/dead_units`` and ``train/effective_rank``.

A module shows a layer with ``self.sow(SHOWN, <activation>, outputs)``. Where nobody looks, that costs nothing and leaves no trace in the
compiled program.
"""

from collections.abc import Callable

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from thorndike.functional.learning_dynamics import gradient_norms, mean_square_gradient, unit_metrics
from thorndike.networks.network import Network, as_rows
from thorndike.types import Metrics, Observation

SHOWN = "intermediates"
"""Flax's collection that ``init`` leaves out."""
ROWS = 512
"""Observations that a network is looked at with."""


def hidden_layers(module: nn.Module, method: Callable | None = None) -> Callable[..., PyTree]:
    """Parameters, inputs of the module (or its ``method``) -> a tree of what its layers show, by module, activation and number."""

    def layers(params: PyTree, *inputs: PyTree) -> PyTree:
        return module.apply({"params": params}, *inputs, mutable=[SHOWN], method=method)[1].get(SHOWN, {})

    return layers


def some_rows(obs: Observation) -> Observation:
    """At most ``ROWS`` of the observations ``[T, B, ...]``, at equal distances, as ``[N, ...]``."""
    rows = as_rows(obs)
    every = -(-jax.tree.leaves(rows)[0].shape[0] // ROWS)
    return jax.tree.map(lambda x: x[::every], rows)


def look_into(network: Network, params: PyTree, obs: Observation, squares: PyTree, name: str | None = None) -> Metrics:
    """Dead units, effective ranks and gradient norms of a network, from observations ``[N, ...]`` and the mean squared gradient.

    ``squares`` is shaped as ``params``, or is its flat vector; ``name`` tells the network from others of the same learner. Of a network
    of the user's own, which shows no layers, the norms alone.
    """
    by_module = network.modules(ravel_pytree(params)[1](ravel_pytree(squares)[0]))
    units = {} if network.layers is None else unit_metrics(network.layers(params, obs), name)
    return units | gradient_norms(by_module, name)


def look_into_rollout(network: Network, params: PyTree, obs: Observation, opt_state: PyTree) -> Metrics:
    """The same of an on-policy learner, from the observations ``[T, B, ...]`` of its latest rollout and the state of its optimiser."""
    return look_into(network, params, some_rows(obs), mean_square_gradient(opt_state))


def look_into_ensemble(
    name: str,
    layers: Callable[[Array], PyTree],
    modules: Callable[[Array], PyTree],
    held: Float[Array, "K H"],
    squares: Float[Array, "K P"],
) -> Metrics:
    """The same of ``K`` networks side by side, as one module ``name``: the mean over them.

    ``layers``: what one of them computes with, a row of ``held`` -> what its layers show; ``modules``: a vector shaped as its parameters
    -> tree.
    """
    each = jax.vmap(lambda row: unit_metrics(layers(row), name))(held)
    return jax.tree.map(lambda x: jnp.mean(x, axis=0), each) | gradient_norms(modules(jnp.mean(squares, axis=0)), name)
