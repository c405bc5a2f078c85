"""Random orders of a batch's rows, for epochs of minibatches."""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, Key

from thorndike.errors import UserError


def permutations(key: Key[Array, ""], count: int, n: int) -> Int[Array, "{count} {n}"]:
    """``count`` random orders of ``range(n)``. Consumes the key.

    Up to 4096 rows, random high bits and the row number share one 32-bit word, so that one sort of words does it (measured on a CPU: 5x
    faster than sorting pairs), and one draw serves all orders (each place that draws costs 0.3 CPU-seconds to compile). Two rows then
    share their random bits with a chance below n^2 / 2^21, and keep their order if they do.
    """
    low_bits = max(1, math.ceil(math.log2(n)))
    if low_bits > 12:
        return jax.vmap(lambda k: jax.random.permutation(k, n))(jax.random.split(key, count))
    mask = jnp.uint32((1 << low_bits) - 1)
    words = (jax.random.bits(key, (count, n), jnp.uint32) & ~mask) | jnp.arange(n, dtype=jnp.uint32)[None]
    return (jnp.sort(words, axis=-1) & mask).astype(jnp.int32)


def minibatches(key: Key[Array, ""], n: int, epochs: int, batch_size: int) -> Int[Array, "minibatches {batch_size}"]:
    """Row numbers of the minibatches of several passes over ``n`` rows, in a new order each pass. Consumes the key.

    The rows themselves are gathered where a minibatch is used: a copy of every pass would hold a rollout of images ten times.
    """
    return permutations(key, epochs, n).reshape(-1, batch_size)


def minibatch_size(algorithm: str, n_steps: int, num_envs: int, batch_size: int, sequences: bool = False) -> int:
    """Items of a minibatch: rows of a rollout, or whole ``sequences``, one an environment. Raises ``UserError`` if they do not divide."""
    rows = n_steps * num_envs
    items, each = (num_envs, n_steps) if sequences else (rows, 1)
    size = min(max(1, batch_size // each), items)
    if items % size:
        raise UserError(
            f"{algorithm}: n_steps x environments = {n_steps} x {num_envs} = {rows} rows do not divide into minibatches of "
            f"batch_size {batch_size}; choose a batch_size that divides {rows}" + (f" and {each} divides" if sequences else "")
        )
    return size
