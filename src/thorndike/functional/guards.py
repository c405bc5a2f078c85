"""Keeping a learner out of harm: an update that is not a number is not applied."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree


def all_finite(*numbers: Float[Array, ""]) -> Bool[Array, ""]:
    """Whether none of these scalars is NaN or infinite. A gradient's norm speaks for all of its entries."""
    return jnp.all(jnp.isfinite(jnp.stack(numbers)))


def accept_if(accepted: Bool[Array, ""], new: PyTree, old: PyTree) -> PyTree:
    """``new`` where the update was accepted, else ``old``: a select, which fuses with the update, and no branch, which would copy."""
    return jax.tree.map(lambda a, b: jnp.where(accepted, a, b), new, old)
