"""Dense layers whose gradient is fast on a CPU."""

import flax.linen as nn
import jax
from jax.lax import optimization_barrier
from jaxtyping import Array, Float

_NARROW = 128
"""Widths up to which the gradient's own form wins; where both are above, the copies cost what they save (measured with 256 x 256)."""

_FEW = 32
"""Widths up to which columns are the cheaper ones to copy."""


@jax.custom_vjp
def product(x: Float[Array, "*B I"], kernel: Float[Array, "I O"]) -> Float[Array, "*B O"]:
    """``x @ kernel``, whose gradient with respect to the kernel is a product of rows with columns as they lie in memory.

    That gradient contracts the leading axes of two narrow matrices. XLA's CPU backend runs such a product as a plain loop (measured on one
    core, 128 rows: 4 -> 64 alone in 16 us, 4 Gflop/s, against 0.6 us with the input copied to its transpose before; PPO's update with two
    networks of 64 x 64 in 8 % less time). The barriers keep the compiler from undoing the copies. It has no forward-mode derivative of its
    own; forward over reverse works.
    """
    return x @ kernel


def _forward(x: Float[Array, "*B I"], kernel: Float[Array, "I O"]) -> tuple[Float[Array, "*B O"], tuple[Array, Array]]:
    return x @ kernel, (x, kernel)


def _backward(held: tuple[Array, Array], gradient: Float[Array, "*B O"]) -> tuple[Float[Array, "*B I"], Float[Array, "I O"]]:
    x, kernel = held
    rows, columns = x.reshape(-1, kernel.shape[0]), gradient.reshape(-1, kernel.shape[1])
    return gradient @ kernel.T, _kernel_gradient(rows, columns)


def _kernel_gradient(rows: Float[Array, "N I"], columns: Float[Array, "N O"]) -> Float[Array, "I O"]:
    """The sum of outer products. One of the two matrices is copied to its transpose: the columns if they are few, else the rows.

    Measured for 400 x 64 (120 x 84, 256 x 12) and 128 to 2048 rows: 190 (140, 200) Gflop/s with the columns copied, 245 (190, 130) with
    the rows.
    """
    inputs, outputs = rows.shape[1], columns.shape[1]
    if outputs == 1:
        return (columns.T @ rows).T
    if outputs < inputs and outputs <= _FEW:
        return optimization_barrier(optimization_barrier(columns.T) @ rows).T
    return optimization_barrier(rows.T) @ columns


product.defvjp(_forward, _backward)


def _dot_general(x: Array, kernel: Array, dimension_numbers: object, precision: object = None) -> Array:
    """What ``nn.Dense`` asks for: the last axis of the input with the first of the kernel."""
    narrow = min(kernel.shape) <= _NARROW and jax.default_backend() == "cpu"
    return product(x, kernel) if narrow else x @ kernel


def dense(features: int, kernel_init: nn.initializers.Initializer, name: str | None = None) -> nn.Dense:
    """``nn.Dense``, with its names, parameters and values."""
    return nn.Dense(features, kernel_init=kernel_init, dot_general=_dot_general, name=name)
