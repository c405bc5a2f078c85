"""Generating text: one compiled loop that ends early, writes its key-value cache in place and keeps the log-probability of every token.

Prompts are padded on the left, to one of a few lengths, so that little is compiled. The log-probabilities are those of the whole
distribution at the sampling temperature, before top-k and top-p cut it: what policy-gradient learners divide by.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from thorndike.errors import UserError
from thorndike.functional.token_sampling import sample_tokens
from thorndike.language.data import Text, prompt_tokens
from thorndike.language.decoder import Cache, Params, decode_step, logits, prefill
from thorndike.language.model import LanguageModel, stop_tokens
from thorndike.language.model_config import ModelConfig
from thorndike.settings import AtLeast, Between, check


@dataclass(frozen=True)
class Sampling:
    """How the next token is chosen."""

    temperature: Annotated[float, AtLeast(0)] = 1.0  # 0: the likeliest token
    top_k: Annotated[int, AtLeast(0)] = 0  # among so many likeliest tokens; 0: all
    top_p: Annotated[float, Between(0, 1)] = 1.0  # among the likeliest tokens that have this probability together

    def __post_init__(self) -> None:
        check(self)


AS_TRAINED, GREEDY = Sampling(), Sampling(temperature=0.0)
"""From the model's own distribution, and its likeliest token."""


class Generated(NamedTuple):
    """What was written after each prompt; after a row's end there is padding, of log-probability 0."""

    tokens: Int[Array, "B N"]
    log_probs: Float[Array, "B N"]
    lengths: Int[Array, " B"]
    """Tokens of each row, the one that ended it included."""
    ended: Bool[Array, " B"]
    """Whether a stop token ended it, rather than the limit."""


class Decoding(NamedTuple):
    """Generation under way."""

    step: Int[Array, ""]
    """Tokens written so far; the last of them is not in the cache yet."""
    generated: Generated
    cache: Cache
    visible: Bool[Array, "B slots"]
    """Slots of the cache that hold a token of the row."""
    next_positions: Int[Array, " B"]
    uniform: Float[Array, "N B"]


def generate(
    params: Params,
    config: ModelConfig,
    tokens: Int[Array, "B P"],
    segments: Int[Array, "B P"],
    key: Key[Array, ""],
    *,
    max_new_tokens: int,
    sampling: Sampling = Sampling(),
    stop_tokens: Sequence[int] | None = None,
    samples: int = 1,
    pad_id: int | None = None,
) -> Generated:
    """Go on with prompts that are padded on the left (segment 0), until a stop token or the limit; ``samples`` rows a prompt, side by side.

    ``stop_tokens`` are the model's end-of-text tokens unless given. Consumes the key. Raises ``UserError`` for what is longer than the
    model can read.
    """
    stops = _stops(config, stop_tokens)
    padding = (config.pad_token_id or 0) if pad_id is None else pad_id
    state = _begin(params, config, tokens, segments, key, stops, padding, max_new_tokens, sampling, samples)
    return _advance(params, config, state, stops, padding, jnp.int32(max_new_tokens), sampling).generated


def stream(
    params: Params,
    config: ModelConfig,
    tokens: Int[Array, "B P"],
    segments: Int[Array, "B P"],
    key: Key[Array, ""],
    *,
    max_new_tokens: int,
    sampling: Sampling = Sampling(),
    stop_tokens: Sequence[int] | None = None,
    every: int = 4,
) -> Iterator[Generated]:
    """The same text as ``generate``, handed out while it grows: after the first token, then after ``every`` further ones."""
    stops, padding = _stops(config, stop_tokens), config.pad_token_id or 0
    state = _begin(params, config, tokens, segments, key, stops, padding, max_new_tokens, sampling, 1)
    yield jax.tree.map(np.array, state.generated)
    for until in range(1 + every, max_new_tokens + every, every):
        if bool(jnp.all(state.generated.ended)):
            return
        state = _advance(params, config, state, stops, padding, jnp.int32(min(until, max_new_tokens)), sampling)
        yield jax.tree.map(np.array, state.generated)


def generate_texts(
    model: LanguageModel,
    prompts: Sequence[Text],
    *,
    max_new_tokens: int = 64,
    sampling: Sampling = Sampling(),
    samples: int = 1,
    seed: int = 0,
    batch_size: int = 64,
) -> list[list[str]]:
    """``samples`` continuations of every prompt, a text or a conversation."""
    encoded = [prompt_tokens(prompt, model.tokenizer) or [_begin_token(model)] for prompt in prompts]
    answers: list[list[str]] = []
    for number, start in enumerate(range(0, len(encoded), batch_size)):
        part = encoded[start : start + batch_size]
        tokens, segments = left_padded(part, model.tokenizer.pad_id, rows=min(batch_size, bucket(len(part))))
        key = jax.random.fold_in(jax.random.key(seed), number)
        found = generate(
            model.params, model.config, tokens, segments, key, max_new_tokens=max_new_tokens, sampling=sampling, samples=samples,
            stop_tokens=stop_tokens(model), pad_id=model.tokenizer.pad_id,
        )  # fmt: skip
        texts = generated_texts(model, found)
        answers += [texts[row * samples : (row + 1) * samples] for row in range(len(part))]
    return answers


def stream_text(
    model: LanguageModel,
    prompt: Sequence[int],
    *,
    max_new_tokens: int = 256,
    sampling: Sampling = Sampling(),
    seed: int = 0,
) -> Iterator[str]:
    """The continuation of one prompt in pieces, as they are written; a character that is not whole yet waits for the next piece."""
    tokens, segments = left_padded([prompt], model.tokenizer.pad_id)
    said = ""
    for found in stream(
        model.params, model.config, tokens, segments, jax.random.key(seed), max_new_tokens=max_new_tokens, sampling=sampling,
        stop_tokens=stop_tokens(model),
    ):  # fmt: skip
        text = generated_texts(model, found)[0].rstrip("\ufffd")
        if text.startswith(said) and len(text) > len(said):
            yield text[len(said) :]
            said = text


def generated_texts(model: LanguageModel, generated: Generated) -> list[str]:
    """The text of each row."""
    rows = zip(np.asarray(generated.tokens), np.asarray(generated.lengths), strict=True)
    return [model.tokenizer.decode(row[:length]) for row, length in rows]


def left_padded(
    prompts: Sequence[Sequence[int]], pad_id: int, width: int | None = None, rows: int | None = None
) -> tuple[Int[Array, "B P"], Int[Array, "B P"]]:
    """Prompts as one array, the padding before them, and their segments: 1 for text, 0 for padding.

    The width is the next of a few lengths unless given; ``rows`` repeats the last prompt until there are so many.
    """
    if not prompts or not all(prompts):
        raise UserError("a prompt is empty: the model needs at least one token to go on from")
    filled = [*prompts, *[prompts[-1]] * ((rows or len(prompts)) - len(prompts))]
    size = bucket(max(map(len, prompts))) if width is None else width
    tokens, segments = np.full((len(filled), size), pad_id, np.int32), np.zeros((len(filled), size), np.int32)
    for row, prompt in enumerate(filled):
        tokens[row, size - len(prompt) :] = prompt
        segments[row, size - len(prompt) :] = 1
    return jnp.asarray(tokens), jnp.asarray(segments)


def bucket(length: int) -> int:
    """The length that is compiled for: a power of two from 8 to 64, above that a multiple of 64."""
    return max(8, 2 ** (length - 1).bit_length()) if length <= 64 else -(-length // 64) * 64


def _stops(config: ModelConfig, given: Sequence[int] | None) -> Int[Array, " stops"]:
    found = config.eos_token_ids if given is None else tuple(given)
    return jnp.asarray(found or (-1,), jnp.int32)


def _begin_token(model: LanguageModel) -> int:
    begin = model.tokenizer.bos_id if model.tokenizer.bos_id is not None else model.tokenizer.eos_id
    if begin is None:
        raise UserError("a prompt is empty and the tokenizer has no token that begins a text: write at least a word")
    return begin


@partial(jax.jit, static_argnames=("config", "padding", "room", "sampling", "samples"))
def _begin(
    params: Params,
    config: ModelConfig,
    tokens: Int[Array, "B P"],
    segments: Int[Array, "B P"],
    key: Key[Array, ""],
    stops: Int[Array, " stops"],
    padding: int,
    room: int,
    sampling: Sampling,
    samples: int,
) -> Decoding:
    """Read the prompts, once each, and write the first token of every row."""
    hidden, cache = prefill(params, config, tokens, segments, room)
    hidden, cache, segments = jax.tree.map(lambda x: jnp.repeat(x, samples, axis=0), (hidden, cache, segments))
    rows = hidden.shape[0]
    uniform = jax.random.uniform(key, (room, rows))
    empty = Generated(
        jnp.full((rows, room), padding, jnp.int32), jnp.zeros((rows, room)), jnp.zeros(rows, jnp.int32), jnp.zeros(rows, bool)
    )
    generated = _written(params, config, hidden, jnp.int32(0), empty, uniform, stops, padding, sampling)
    visible = jnp.pad(segments > 0, ((0, 0), (0, room)))
    return Decoding(jnp.int32(1), generated, cache, visible, jnp.sum(segments > 0, axis=1, dtype=jnp.int32), uniform)


@partial(jax.jit, static_argnames=("config", "padding", "sampling"), donate_argnames=("state",))
def _advance(
    params: Params,
    config: ModelConfig,
    state: Decoding,
    stops: Int[Array, " stops"],
    padding: int,
    until: Int[Array, ""],
    sampling: Sampling,
) -> Decoding:
    """Write until so many tokens are there, or every row has ended."""

    def unfinished(state: Decoding) -> Bool[Array, ""]:
        return (state.step < until) & ~jnp.all(state.generated.ended)

    def write(state: Decoding) -> Decoding:
        step, room = state.step, state.generated.tokens.shape[1]
        last = jax.lax.dynamic_index_in_dim(state.generated.tokens, step - 1, axis=1, keepdims=False)
        slot = state.visible.shape[1] - room + step - 1
        visible = jax.lax.dynamic_update_slice_in_dim(state.visible, jnp.ones_like(state.visible[:, :1]), slot, axis=1)
        hidden, cache = decode_step(params, config, last, state.next_positions, slot, visible, state.cache)
        generated = _written(params, config, hidden, step, state.generated, state.uniform, stops, padding, sampling)
        return Decoding(step + 1, generated, cache, visible, state.next_positions + 1, state.uniform)

    return jax.lax.while_loop(unfinished, write, state)


def _written(
    params: Params,
    config: ModelConfig,
    hidden: Float[Array, "B d"],
    step: Int[Array, ""],
    generated: Generated,
    uniform: Float[Array, "N B"],
    stops: Int[Array, " stops"],
    padding: int,
    sampling: Sampling,
) -> Generated:
    """One further token a row; rows that have ended get padding."""
    scores = logits(params, config, hidden)
    drawn, log_probs = sample_tokens(scores, uniform[step], sampling.temperature, sampling.top_k, sampling.top_p)
    open_rows = ~generated.ended
    token, log_prob = jnp.where(open_rows, drawn, padding), jnp.where(open_rows, log_probs, 0.0)
    return Generated(
        jax.lax.dynamic_update_slice_in_dim(generated.tokens, token[:, None], step, axis=1),
        jax.lax.dynamic_update_slice_in_dim(generated.log_probs, log_prob[:, None], step, axis=1),
        generated.lengths + open_rows,
        generated.ended | (open_rows & jnp.any(token[:, None] == stops[None], axis=1)),
    )
