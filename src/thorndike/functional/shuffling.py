"""Random orders of a batch's rows, for epochs of minibatches."""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, Key, UInt32

_LARGEST = 16
"""Bits of a row's number, at most: half of a word."""


def permutations(key: Key[Array, ""], count: int, n: int) -> Int[Array, "{count} {n}"]:
    """``count`` random orders of ``range(n)``. Consumes the key.

    Random high bits and the row's number share one 32-bit word, so that one sort of words makes an order (measured on a CPU: 5x faster than
    sorting pairs), and one draw serves all orders (each place that draws costs 0.3 CPU-seconds to compile). Two rows whose random bits are
    equal, about n^3 / 2^33 pairs, keep their order. Above 4096 rows those are no longer few: there a second sort begins from the order of
    the first, and above 65,536 rows pairs are sorted after all.
    """
    low_bits = max(1, math.ceil(math.log2(n)))
    if low_bits > _LARGEST:
        return jax.vmap(lambda k: jax.random.permutation(k, n))(jax.random.split(key, count))
    rounds = 1 if low_bits <= 12 else 2
    first, *second = (_order_by(words, low_bits) for words in jax.random.bits(key, (rounds, count, n), jnp.uint32))
    return jnp.take_along_axis(first, second[0], axis=-1) if second else first


def _order_by(words: UInt32[Array, "count n"], low_bits: int) -> Int[Array, "count n"]:
    """The order of ``range(n)`` by the high bits of random words."""
    mask = jnp.uint32((1 << low_bits) - 1)
    numbered = (words & ~mask) | jnp.arange(words.shape[-1], dtype=jnp.uint32)[None]
    return (jnp.sort(numbered, axis=-1) & mask).astype(jnp.int32)


def minibatches(key: Key[Array, ""], n: int, epochs: int, batch_size: int) -> Int[Array, "minibatches {batch_size}"]:
    """Row numbers of the minibatches of several passes over ``n`` rows, in a new order each pass. Consumes the key.

    The rows themselves are gathered where a minibatch is used: a copy of every pass would hold a rollout of images ten times.
    """
    return permutations(key, epochs, n).reshape(-1, batch_size)
