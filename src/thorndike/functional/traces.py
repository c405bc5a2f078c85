"""Eligibility traces over a whole table: how much of an error each state and action that led here is owed."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from thorndike.types import Number


class Place(NamedTuple):
    """Where a step lies in tables that stack the seeds' rows."""

    first: Int[Array, ""]
    """The seed's first row in the table of values."""
    env: Int[Array, ""]
    """The environment's trace."""
    state: Int[Array, ""]
    action: Int[Array, ""]


def watkins(
    q: Float[Array, "rows actions"],
    traces: Float[Array, "envs states actions"],
    place: Place,
    change: Float[Array, ""],
    fading: Number,
    kept: Float[Array, ""],
) -> tuple[Float[Array, "rows actions"], Float[Array, "envs states actions"]]:
    """Values and traces after a step: traces fade (to 0 after an exploring action), that of the step becomes 1, and values change by them.

    Watkins 1989, with replacing traces: Sutton and Barto 1998, section 7.8. ``kept`` is 0 where the episode ends here, else 1.
    """
    trace = lax.dynamic_index_in_dim(traces, place.env, keepdims=False) * fading
    trace = lax.dynamic_update_slice(trace, jnp.ones((1, 1), trace.dtype), (place.state, place.action))
    own = lax.dynamic_slice_in_dim(q, place.first, len(trace)) + change * trace
    return lax.dynamic_update_slice_in_dim(q, own, place.first, 0), lax.dynamic_update_index_in_dim(traces, kept * trace, place.env, 0)
