"""Random numbers for native environments: one 32-bit word a reset or a step, drawn ahead of the scan and spread where it is used.

JAX's threefry costs about 7 ns a word on one core, and four numbers a reset on the last axis 40 ns: more than a whole step of CartPole,
and nearly all of it thrown away, since most steps end no episode. So a reset gets one word, and ``uniforms`` spreads it by an
integer hash with full avalanche (lowbias32, C. Wellons, "Prospecting for Hash Functions", 2018, public domain).
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key, UInt32

GOLDEN = 0x9E3779B9


def no_noise(key: Key[Array, ""], shape: tuple[int, ...]) -> tuple[()]:
    """The draw of an environment that has no randomness there."""
    del key, shape
    return ()


def draw_words(key: Key[Array, ""], shape: tuple[int, ...]) -> UInt32[Array, "..."]:
    """One random word for each place of ``shape``. Consumes the key."""
    return jax.random.bits(key, shape, jnp.uint32)


def uniforms(words: UInt32[Array, "*batch"], count: int, low: float, high: float) -> Float[Array, "*batch count"]:
    """``count`` numbers, each uniform in ``[low, high)`` with 24 bits, from each word."""
    offsets = jax.lax.iota(jnp.uint32, count) * jnp.uint32(GOLDEN)
    bits = _mix(words[..., None] + offsets.reshape((1,) * words.ndim + (count,)))
    return low + (high - low) * unit_interval(bits)


def unit_interval(words: UInt32[Array, "*batch"]) -> Float[Array, "*batch"]:
    """A number in ``[0, 1)`` with 24 bits from each word."""
    return (words >> 8).astype(jnp.int32).astype(jnp.float32) * jnp.float32(2.0**-24)


def _mix(bits: UInt32[Array, "*batch"]) -> UInt32[Array, "*batch"]:
    """A bijection of words in which every input bit flips every output bit half of the time."""
    bits = (bits ^ (bits >> 16)) * jnp.uint32(0x7FEB352D)
    bits = (bits ^ (bits >> 15)) * jnp.uint32(0x846CA68B)
    return bits ^ (bits >> 16)
