"""Models that give a text one number: reward and value models, ``*ForSequenceClassification`` with ``num_labels=1`` in transformers."""

from dataclasses import replace
from typing import Literal, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from thorndike.errors import UserError
from thorndike.language.decoder import Params, hidden_states
from thorndike.language.model_config import ModelConfig

Pool: TypeAlias = Literal["last", "mean"]
"""The number is that of the last token, as in transformers, or of the mean of all, from which small models learn more easily."""


def with_scalar_head(params: Params, config: ModelConfig, key: Key[Array, ""], zero: bool = False) -> tuple[Params, ModelConfig]:
    """A language model turned into one that scores: its output layer gives way to a head of deviation ``1 / sqrt(d + 1)``, or of zeros.

    Consumes the key. Raises ``UserError`` where no padding token is known: transformers finds the last token by it.
    """
    if config.pad_token_id is None:
        raise UserError("a model with a scalar head needs a padding token in its config: set pad_token_id")
    deviation = 0.0 if zero else (config.hidden_size + 1) ** -0.5
    kernel = deviation * jax.random.normal(key, (config.hidden_size, 1))
    kept = {name: part for name, part in params.items() if name not in ("output", "score")}
    return kept | {"score": {"kernel": kernel.astype(jnp.dtype(config.dtype))}}, replace(config, num_labels=1)


def token_values(
    params: Params, config: ModelConfig, tokens: Int[Array, "B T"], segments: Int[Array, "B T"], remat: bool = False
) -> Float[Array, "B T"]:
    """The head's number at every token."""
    return _scored(params, hidden_states(params, config, tokens, segments, remat))


def text_scores(
    params: Params, config: ModelConfig, tokens: Int[Array, "B T"], segments: Int[Array, "B T"], pool: Pool = "last", remat: bool = False
) -> Float[Array, " B"]:
    """One number a text, padded on either side with segment 0."""
    hidden, real = hidden_states(params, config, tokens, segments, remat), segments > 0
    if pool == "mean":
        weights = real.astype(jnp.float32) / jnp.maximum(jnp.sum(real, axis=1, keepdims=True), 1)
        return _scored(params, jnp.einsum("btd,bt->bd", hidden.astype(jnp.float32), weights))
    last = jnp.max(jnp.where(real, jnp.arange(tokens.shape[1])[None], 0), axis=1)
    return _scored(params, jnp.take_along_axis(hidden, last[:, None, None], axis=1)[:, 0])


def _scored(params: Params, hidden: Float[Array, "*rows d"]) -> Float[Array, "*rows"]:
    kernel = params["score"]["kernel"]
    flat = hidden.reshape(-1, hidden.shape[-1])
    return (flat @ kernel.astype(flat.dtype)).astype(jnp.float32).reshape(hidden.shape[:-1])
