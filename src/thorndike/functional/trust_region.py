"""The two tools of a trust-region step: the conjugate gradient method and a backtracking line search.

Schulman, Levine, Moritz, Jordan, Abbeel 2015, "Trust Region Policy Optimization" (arXiv:1502.05477), appendix C.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from thorndike.types import Number

_SMALL = 1e-10
"""The squared residual at which a solution is as good as float32 allows."""


def conjugate_gradient(
    product: Callable[[Float[Array, " P"]], Float[Array, " P"]], right: Float[Array, " P"], max_steps: int
) -> Float[Array, " P"]:
    """``x`` with ``A x = right``, from products ``A p`` alone; ``A`` is symmetric and positive definite. Hestenes and Stiefel 1952.

    Exact after ``P`` steps but for rounding; it stops before ``max_steps`` where the residual vanishes.
    """

    def unsolved(held: tuple[Array, Array, Array, Array, Int[Array, ""]]) -> Bool[Array, ""]:
        return (held[4] < max_steps) & (held[3] > _SMALL)

    def step(held: tuple[Array, Array, Array, Array, Int[Array, ""]]) -> tuple[Array, Array, Array, Array, Int[Array, ""]]:
        x, residual, search, squared, count = held
        moved = product(search)
        rate = squared / jnp.dot(search, moved)
        residual = residual - rate * moved
        left = jnp.dot(residual, residual)
        return x + rate * search, residual, residual + (left / squared) * search, left, count + 1

    begin = (jnp.zeros_like(right), right, right, jnp.dot(right, right), jnp.zeros((), jnp.int32))
    return jax.lax.while_loop(unsolved, step, begin)[0]


class Found(NamedTuple):
    """Where a line search ended."""

    fraction: Float[Array, ""]
    """Of the full step; 0 if no step was accepted."""
    accepted: Bool[Array, ""]


def backtracking_line_search(accepts: Callable[[Float[Array, ""]], Bool[Array, ""]], shrinking_factor: Number, max_iter: int) -> Found:
    """The largest of ``1, f, f^2, ...`` (``max_iter`` of them) that ``accepts`` takes. Armijo 1966; Schulman et al. 2015, appendix C."""

    def going(held: tuple[Float[Array, ""], Bool[Array, ""], Int[Array, ""]]) -> Bool[Array, ""]:
        return ~held[1] & (held[2] < max_iter)

    def shrink(
        held: tuple[Float[Array, ""], Bool[Array, ""], Int[Array, ""]],
    ) -> tuple[Float[Array, ""], Bool[Array, ""], Int[Array, ""]]:
        fraction = jnp.where(held[2] == 0, 1.0, held[0] * shrinking_factor)
        return fraction, accepts(fraction), held[2] + 1

    begin = (jnp.ones((), jnp.float32), jnp.zeros((), jnp.bool_), jnp.zeros((), jnp.int32))
    fraction, accepted, _ = jax.lax.while_loop(going, shrink, begin)
    return Found(jnp.where(accepted, fraction, 0.0), accepted)
