"""The last few parameter sets of a learner, so that what acts may be some updates old: the policy lag of asynchronous methods."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int


class ParameterHistory(NamedTuple):
    """A ring of parameter sets, each one flat vector."""

    sets: Float[Array, "H P"]
    version: Int[Array, ""]
    """Updates made so far; the set of version ``v`` lies at ``v mod H``."""


def new_history(params: Float[Array, " P"], length: int) -> ParameterHistory:
    """Before the first update; ``length``, at least 1, sets will be kept."""
    return ParameterHistory(jnp.tile(params[None], (length, 1)), jnp.zeros((), jnp.int32))


def updated(history: ParameterHistory, params: Float[Array, " P"]) -> ParameterHistory:
    """With ``params`` as the newest set, in the place of the oldest."""
    version = history.version + 1
    sets = jax.lax.dynamic_update_index_in_dim(history.sets, params, version % history.sets.shape[0], 0)
    return ParameterHistory(sets, version)


def of_version(history: ParameterHistory, version: Int[Array, ""]) -> Float[Array, " P"]:
    """The set of a version; of one that is no longer kept, the oldest there is, of one before the first update, the first."""
    length = history.sets.shape[0]
    kept = jnp.clip(version, jnp.maximum(history.version - length + 1, 0), history.version)
    return jax.lax.dynamic_index_in_dim(history.sets, kept % length, keepdims=False)


def newest(history: ParameterHistory) -> Float[Array, " P"]:
    """The set that the next update starts from."""
    return of_version(history, history.version)
