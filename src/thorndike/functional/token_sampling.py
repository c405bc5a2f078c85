"""Drawing tokens from logits ``[B, V]``: temperature, top-k, top-p, and the log-probability of what was drawn.

``jax.random.categorical`` draws a random number a token of the vocabulary; here one uniform number a row is looked up in the cumulative
distribution, block by block. Top-k and top-p bisect over the bits of the probabilities instead of sorting them.
"""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

_ONE = 0x3F800000
"""The bits of 1.0: those of smaller positive floats are smaller numbers."""


def sample_tokens(
    logits: Float[Array, "B V"], uniform: Float[Array, " B"], temperature: float = 1.0, top_k: int = 0, top_p: float = 1.0
) -> tuple[Int[Array, " B"], Float[Array, " B"]]:
    """One token a row, and its log-probability under ``softmax(logits / temperature)``, before anything was cut off.

    ``uniform`` in [0, 1). Temperature 0 takes the likeliest token, with its log-probability at temperature 1. ``top_k`` 0 and ``top_p`` 1
    cut nothing; top-p is of what top-k left; tokens as likely as the last one kept are kept too.
    """
    scaled = logits / (temperature or 1.0)
    highest = jnp.max(scaled, axis=-1, keepdims=True)
    weights = jnp.exp(scaled - highest)
    normaliser = highest[:, 0] + jnp.log(jnp.sum(weights, axis=-1))
    tokens = jnp.argmax(logits, axis=-1) if temperature == 0.0 else look_up(kept_weights(weights, top_k, top_p), uniform)
    return tokens.astype(jnp.int32), jnp.take_along_axis(scaled, tokens[:, None], axis=-1)[:, 0] - normaliser


def kept_weights(weights: Float[Array, "B V"], top_k: int, top_p: float) -> Float[Array, "B V"]:
    """Weights between 0 and 1, with 0 for what top-k (Fan et al. 2018) and top-p (Holtzman et al. 2020) leave out."""
    if 0 < top_k < weights.shape[-1]:
        weights = _from(weights, lambda kept: jnp.sum(kept, axis=-1) >= top_k)
    if top_p < 1.0:
        enough = top_p * jnp.sum(weights, axis=-1)
        whole = weights
        weights = _from(weights, lambda kept: jnp.sum(jnp.where(kept, whole, 0.0), axis=-1) >= enough)
    return weights


def look_up(weights: Float[Array, "B V"], uniform: Float[Array, " B"]) -> Int[Array, " B"]:
    """The token at a fraction ``uniform`` of the total weight of its row: first its block of about sqrt(V) tokens, then itself."""
    batch, size = weights.shape
    width = 2 ** math.ceil(math.log2(size) / 2)
    blocks = jnp.pad(weights, ((0, 0), (0, -size % width))).reshape(batch, -1, width)
    sums = jnp.sum(blocks, axis=-1)
    # The total as the sum that is looked up, so that rounding never leads past the end.
    reached = jnp.cumsum(sums, axis=-1)
    target = uniform * reached[:, -1]
    block = _first(reached > target[:, None], sums)
    inside = jnp.take_along_axis(blocks, block[:, None, None], axis=1)[:, 0]
    before = jnp.take_along_axis(reached, block[:, None], axis=-1)[:, 0] - jnp.take_along_axis(sums, block[:, None], axis=-1)[:, 0]
    place = _first(jnp.cumsum(inside, axis=-1) > (target - before)[:, None], inside)
    return block * width + place


def _first(past: Bool[Array, "B n"], weights: Float[Array, "B n"]) -> Int[Array, " B"]:
    """The first place past the target that has any weight; by rounding there may be none, and then the heaviest."""
    found = past & (weights > 0)
    return jnp.where(jnp.any(found, axis=-1), jnp.argmax(found, axis=-1), jnp.argmax(weights, axis=-1))


def _from(weights: Float[Array, "B V"], enough: Callable[[Bool[Array, "B V"]], Bool[Array, " B"]]) -> Float[Array, "B V"]:
    """The weights from the highest threshold on with which ``enough(kept)``, 0 for the others."""
    bits = jax.lax.bitcast_convert_type(weights.astype(jnp.float32), jnp.int32)

    def halve(_: Array, bounds: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = bounds
        middle = low + (high - low) // 2
        fits = enough(bits >= middle[:, None])
        return jnp.where(fits, middle, low), jnp.where(fits, high, middle)

    low = jnp.zeros(weights.shape[:1], jnp.int32)
    threshold, _ = jax.lax.fori_loop(0, 31, halve, (low, jnp.full_like(low, _ONE + 1)))
    return jnp.where(bits >= threshold[:, None], weights, 0.0)
