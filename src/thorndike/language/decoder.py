"""A decoder-only transformer as pure functions on a pytree: GPT-2, Llama, Mistral, Qwen, Gemma and Phi-3 are settings of it.

Vaswani et al. 2017 (arXiv:1706.03762); grouped queries: Ainslie et al. 2023 (arXiv:2305.13245). Query, key and value projections are one
matrix, and so are gate and up. Activations are ``[rows, d]`` at every matrix product: on XLA:CPU the gradient of one with three axes runs
at a third of the speed. Which tokens see each other is told by ``segments``: 0 is padding, tokens of equal number see each other, so that a
padding mask is one case, and several short texts packed into one row another.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from thorndike.errors import UserError
from thorndike.functional.policy_divergence import categorical_divergence
from thorndike.language.model_config import ModelConfig
from thorndike.language.rope import Rope, frequencies

Params: TypeAlias = PyTree
"""``embedding``, ``positions`` (GPT-2), ``layers`` (a tuple), ``norm``, ``output`` (unless tied), ``score`` (with a scalar head)."""

_HIDDEN_SCORE = -1e30
"""Added to the attention scores of what is not seen; not infinite, so that padding that sees nothing gives numbers."""
_ACTIVATIONS: dict[str, Callable[[Array], Array]] = {
    "silu": jax.nn.silu,
    "gelu": partial(jax.nn.gelu, approximate=False),
    "gelu_tanh": partial(jax.nn.gelu, approximate=True),
    "relu": jax.nn.relu,
}
_NEVER = -1e30
"""The score of a token that is never chosen; not infinite, so that divergences and gradients are numbers."""
_CHUNK = 2**24
"""Logits that are in memory at once."""


class Cache(NamedTuple):
    """Keys and values of the tokens so far, ``[B, slots, kv_heads, head_dim]`` by layer."""

    keys: tuple[Array, ...]
    values: tuple[Array, ...]


def initial_params(config: ModelConfig, key: Key[Array, ""]) -> Params:
    """Random parameters: normal with deviation 0.02, less for what is added to the residual stream (GPT-2). Consumes the key."""
    shapes = param_shapes(config)
    leaves, structure = jax.tree.flatten_with_path(shapes)
    keys = jax.random.split(key, len(leaves))
    return jax.tree.unflatten(structure, [_initial(path, leaf, config, k) for (path, leaf), k in zip(leaves, keys, strict=True)])


def param_shapes(config: ModelConfig) -> Params:
    """Shapes and dtypes of the parameters."""
    d, f, q, kv = config.hidden_size, config.intermediate_size, config.num_heads * config.head_dim, config.num_kv_heads * config.head_dim

    def array(*shape: int) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(shape, jnp.float32)

    def dense(rows: int, columns: int, bias: bool) -> dict[str, jax.ShapeDtypeStruct]:
        return {"kernel": array(rows, columns)} | ({"bias": array(columns)} if bias else {})

    def norm(size: int = d) -> dict[str, jax.ShapeDtypeStruct]:
        return {"scale": array(size)} | ({"bias": array(size)} if config.layer_norm else {})

    def layer() -> dict[str, dict[str, jax.ShapeDtypeStruct]]:
        parts = {
            "attention_norm": norm(),
            "qkv": dense(d, q + 2 * kv, config.qkv_bias),
            "attention_output": dense(q, d, config.output_bias),
            "mlp_norm": norm(),
            "up": dense(d, 2 * f if config.gated else f, config.mlp_bias),
            "down": dense(f, d, config.mlp_bias),
        }
        if config.qk_norm:
            parts |= {"query_norm": {"scale": array(config.head_dim)}, "key_norm": {"scale": array(config.head_dim)}}
        if config.sandwich_norms:
            parts |= {"attention_post_norm": norm(), "mlp_post_norm": norm()}
        return parts

    params: dict[str, PyTree] = {"embedding": array(config.vocab_size, d), "layers": tuple(layer() for _ in range(config.num_layers))}
    params["norm"] = norm()
    if config.rope is None:
        params["positions"] = array(config.max_positions, d)
    if config.num_labels:
        params["score"] = {"kernel": array(d, 1)}
    elif not config.tied:
        params["output"] = {"kernel": array(config.vocab_size, d)}
    return params


def hidden_states(
    params: Params, config: ModelConfig, tokens: Int[Array, "B T"], segments: Int[Array, "B T"] | None = None, remat: bool = False
) -> Float[Array, "B T d"]:
    """What the last norm gives for every token. ``remat`` recomputes each layer in the backward pass instead of keeping its activations.

    Raises ``UserError`` for texts longer than the model can read exactly.
    """
    _check_length(config, tokens.shape[1])
    segments = jnp.ones_like(tokens) if segments is None else segments
    positions = positions_in(segments)
    masks = {window: _mask(segments, window) for window in dict.fromkeys(config.windows)}

    def attend(number: int, query: Array, key: Array, value: Array) -> Array:
        return _attention(config, query, key, value, masks[config.windows[number]])

    return _stack(params, config, tokens, positions, attend, remat)


def prefill(
    params: Params, config: ModelConfig, tokens: Int[Array, "B T"], segments: Int[Array, "B T"], room: int
) -> tuple[Float[Array, "B d"], Cache]:
    """The hidden state of the last column, and a cache with ``room`` further slots."""
    _check_length(config, tokens.shape[1] + room)
    masks = {window: _mask(segments, window) for window in dict.fromkeys(config.windows)}
    keys, values = [], []

    def attend(number: int, query: Array, key: Array, value: Array) -> Array:
        keys.append(_with_room(key, room))
        values.append(_with_room(value, room))
        return _attention(config, query, key, value, masks[config.windows[number]])

    hidden = _stack(params, config, tokens, positions_in(segments), attend, False)
    return hidden[:, -1], Cache(tuple(keys), tuple(values))


def decode_step(
    params: Params,
    config: ModelConfig,
    tokens: Int[Array, " B"],
    positions: Int[Array, " B"],
    slot: Int[Array, ""],
    visible: Bool[Array, "B slots"],
    cache: Cache,
) -> tuple[Float[Array, "B d"], Cache]:
    """The hidden state of one further token a row, written at ``slot`` of the cache. ``visible``: the slots seen, itself included."""
    slots = jnp.arange(visible.shape[1])
    masks = {
        window: visible[:, None] if window is None else (visible & (slots > slot - window)[None])[:, None]
        for window in dict.fromkeys(config.windows)
    }
    keys, values = [], []

    def attend(number: int, query: Array, key: Array, value: Array) -> Array:
        keys.append(jax.lax.dynamic_update_slice_in_dim(cache.keys[number], key, slot, 1))
        values.append(jax.lax.dynamic_update_slice_in_dim(cache.values[number], value, slot, 1))
        return _attention(config, query, keys[-1], values[-1], masks[config.windows[number]])

    hidden = _stack(params, config, tokens[:, None], positions[:, None], attend, False)
    return hidden[:, 0], Cache(tuple(keys), tuple(values))


def logits(params: Params, config: ModelConfig, hidden: Float[Array, "*rows d"]) -> Float[Array, "*rows V"]:
    """Float32 scores of the whole vocabulary. For many rows use ``by_vocabulary`` or ``token_log_probs``, which never hold them all."""
    table = output_table(params, config)
    flat = hidden.reshape(-1, hidden.shape[-1])
    scores = jax.lax.dot_general(flat, table.astype(flat.dtype), (((1,), (1,)), ((), ())), preferred_element_type=jnp.float32)
    scores = _capped(scores, config.logit_soft_cap)
    if config.never_chosen:
        scores = scores.at[:, jnp.asarray(config.never_chosen)].set(_NEVER)
    return scores.reshape(*hidden.shape[:-1], -1)


def token_log_probs(
    params: Params, config: ModelConfig, hidden: Float[Array, "*rows d"], targets: Int[Array, "*rows"], temperature: float = 1.0
) -> Float[Array, "*rows"]:
    """``log pi(target)`` of each row, at a temperature.

    The target's logit is a product of two rows: picking it out of all logits costs their size once more, in both directions. A target that
    the config never chooses has no meaning here.
    """
    table = output_table(params, config)

    def chosen(rows: Array, targets: Array) -> Array:
        normaliser = jax.nn.logsumexp(logits(params, config, rows) / temperature, axis=-1)
        score = jnp.sum(rows.astype(jnp.float32) * table[targets].astype(rows.dtype).astype(jnp.float32), axis=-1)
        return _capped(score, config.logit_soft_cap) / temperature - normaliser

    flat = (hidden.reshape(-1, hidden.shape[-1]), targets.reshape(-1))
    return by_vocabulary(chosen, flat, config.vocab_size).reshape(targets.shape)


def token_divergences(
    params: Params,
    hidden: Float[Array, "*rows d"],
    reference: Params,
    reference_hidden: Float[Array, "*rows d"],
    config: ModelConfig,
    temperature: float = 1.0,
) -> Float[Array, "*rows"]:
    """The exact divergence ``KL(model || reference)`` of the next token of each row, over the whole vocabulary; both have one config."""

    def exact(rows: Array, others: Array) -> Array:
        return categorical_divergence(logits(params, config, rows) / temperature, logits(reference, config, others) / temperature)

    flat = tuple(each.reshape(-1, each.shape[-1]) for each in (hidden, reference_hidden))
    return by_vocabulary(exact, flat, config.vocab_size).reshape(hidden.shape[:-1])


def by_vocabulary(function: Callable[..., PyTree], rows: tuple[Array, ...], vocab_size: int) -> PyTree:
    """``function(*rows)`` of arrays ``[N, ...]``, so many rows at a time that 16 million logits exist at once, also for gradients."""
    number = rows[0].shape[0]
    chunks = -(-number * vocab_size // _CHUNK)
    if chunks <= 1:
        return function(*rows)
    size = -(-number // chunks)
    padded = [jnp.pad(each, [(0, chunks * size - number)] + [(0, 0)] * (each.ndim - 1)) for each in rows]
    parts = jax.lax.map(lambda part: jax.checkpoint(function)(*part), [each.reshape(chunks, size, *each.shape[1:]) for each in padded])
    return jax.tree.map(lambda part: part.reshape(chunks * size, *part.shape[2:])[:number], parts)


def output_table(params: Params, config: ModelConfig) -> Float[Array, "V d"]:
    """The row of each token that its logit is a product with."""
    return params["embedding"] if config.tied else params["output"]["kernel"]


def positions_in(segments: Int[Array, "B T"]) -> Int[Array, "B T"]:
    """Each token's place in its own segment."""
    places = jnp.arange(segments.shape[1], dtype=jnp.int32)[None]
    begins = jnp.concatenate([jnp.ones_like(segments[:, :1], bool), segments[:, 1:] != segments[:, :-1]], axis=1)
    return places - jax.lax.cummax(jnp.where(begins, places, 0), axis=1)


def _stack(
    params: Params,
    config: ModelConfig,
    tokens: Int[Array, "B T"],
    positions: Int[Array, "B T"],
    attend: Callable[[int, Array, Array, Array], Array],
    remat: bool,
) -> Float[Array, "B T d"]:
    """Embedding, all layers and the last norm; ``attend(layer, query, key, value)`` is what differs between training and decoding."""
    dtype = jnp.dtype(config.dtype)
    x = params["embedding"][tokens.reshape(-1)].astype(dtype) * jnp.asarray(config.embedding_scale, dtype)
    if config.rope is None:
        x += params["positions"][positions.reshape(-1)].astype(dtype)
    turns = {rope: _turns(rope, positions, dtype) for rope in (config.rope, config.local_rope) if rope is not None}
    for number, layer in enumerate(params["layers"]):
        rope = config.rope if config.local_rope is None or config.windows[number] is None else config.local_rope
        block = partial(
            _layer, config=config, shape=tokens.shape, turn=None if rope is None else turns[rope], attend=partial(attend, number)
        )
        x = (jax.checkpoint(block) if remat else block)(layer, x)
    return _norm(params["norm"], config, x).reshape(*tokens.shape, -1)


def _layer(
    layer: Params,
    x: Float[Array, "rows d"],
    config: ModelConfig,
    shape: tuple[int, ...],
    turn: tuple[Array, Array] | None,
    attend: Callable[[Array, Array, Array], Array],
) -> Float[Array, "rows d"]:
    width, kv_width = config.num_heads * config.head_dim, config.num_kv_heads * config.head_dim
    parts = jnp.split(_dense(layer["qkv"], _norm(layer["attention_norm"], config, x)), (width, width + kv_width), axis=-1)
    query, key, value = (part.reshape(*shape, -1, config.head_dim) for part in parts)
    if config.qk_norm:
        query, key = _norm(layer["query_norm"], config, query), _norm(layer["key_norm"], config, key)
    if turn is not None:
        query, key = _turned(query, turn), _turned(key, turn)
    attended = _dense(layer["attention_output"], attend(query, key, value).reshape(-1, width))
    x = x + (_norm(layer["attention_post_norm"], config, attended) if config.sandwich_norms else attended)
    inner = _dense(layer["up"], _norm(layer["mlp_norm"], config, x))
    activation = _ACTIVATIONS[config.activation]
    if config.gated:
        gate, up = jnp.split(inner, 2, axis=-1)
        inner = activation(gate) * up
    else:
        inner = activation(inner)
    out = _dense(layer["down"], inner)
    return x + (_norm(layer["mlp_post_norm"], config, out) if config.sandwich_norms else out)


def _attention(
    config: ModelConfig,
    query: Float[Array, "B T H h"],
    key: Float[Array, "B S K h"],
    value: Float[Array, "B S K h"],
    seen: Bool[Array, "B T S"],
) -> Float[Array, "B T H h"]:
    """Every query with the keys it sees; ``H / K`` query heads share a key."""
    batch, length, heads, size = query.shape
    grouped = query.reshape(batch, length, config.num_kv_heads, heads // config.num_kv_heads, size)
    scores = jnp.einsum("btkgh,bskh->bkgts", grouped * jnp.asarray(config.query_scale, query.dtype), key)
    scores = _capped(scores.astype(jnp.float32), config.attention_soft_cap)
    weights = jax.nn.softmax(jnp.where(seen[:, None, None], scores, _HIDDEN_SCORE), axis=-1).astype(value.dtype)
    return jnp.einsum("bkgts,bskh->btkgh", weights, value).reshape(batch, length, heads, size)


def _mask(segments: Int[Array, "B T"], window: int | None) -> Bool[Array, "B T T"]:
    """Which tokens (last axis) each token sees: those before it and itself, of its own segment, within the window."""
    places = jnp.arange(segments.shape[1])
    seen = places[None, :] <= places[:, None]
    if window is not None:
        seen &= places[None, :] > places[:, None] - window
    return seen[None] & (segments[:, None, :] == segments[:, :, None]) & (segments[:, None, :] > 0)


def _dense(layer: Params, x: Float[Array, "rows n"]) -> Float[Array, "rows m"]:
    out = x @ layer["kernel"].astype(x.dtype)
    return out + layer["bias"].astype(x.dtype)[None] if "bias" in layer else out


def _norm(layer: Params, config: ModelConfig, x: Float[Array, "*rows n"]) -> Float[Array, "*rows n"]:
    """RMSNorm (Zhang and Sennrich 2019, arXiv:1910.07467) or LayerNorm, in float32."""
    wide, scale = x.astype(jnp.float32), layer["scale"].astype(jnp.float32) + config.norm_offset
    if "bias" in layer:
        wide = wide - jnp.mean(wide, axis=-1, keepdims=True)
    normal = wide * jax.lax.rsqrt(jnp.mean(jnp.square(wide), axis=-1, keepdims=True) + config.norm_eps)
    lead = (1,) * (x.ndim - 1)
    out = normal * scale.reshape(*lead, -1)
    return (out + layer["bias"].astype(jnp.float32).reshape(*lead, -1) if "bias" in layer else out).astype(x.dtype)


def _turns(rope: Rope, positions: Int[Array, "B T"], dtype: jnp.dtype) -> tuple[Array, Array]:
    """Cosine and sine ``[B, T, 1, n]`` of the angle of each pair of dimensions."""
    angles = positions.astype(jnp.float32)[..., None] * frequencies(rope)[None, None]
    cosine, sine = ((each[:, :, None] * rope.magnitude).astype(dtype) for each in (jnp.cos(angles), jnp.sin(angles)))
    return cosine, sine


def _turned(x: Float[Array, "B T heads h"], turn: tuple[Array, Array]) -> Float[Array, "B T heads h"]:
    cosine, sine = turn
    half = cosine.shape[-1]
    first, second, rest = x[..., :half], x[..., half : 2 * half], x[..., 2 * half :]
    turned = [first * cosine - second * sine, second * cosine + first * sine]
    return jnp.concatenate([*turned, rest] if rest.shape[-1] else turned, axis=-1)


def _capped(scores: Array, cap: float | None) -> Array:
    return scores if cap is None else cap * jnp.tanh(scores / cap)


def _with_room(x: Float[Array, "B T K h"], room: int) -> Float[Array, "B S K h"]:
    return jnp.pad(x, ((0, 0), (0, room), (0, 0), (0, 0)))


def _check_length(config: ModelConfig, length: int) -> None:
    if length > config.max_positions:
        raise UserError(f"a text of {length} tokens is longer than this model can read exactly ({config.max_positions}); shorten it")


def _initial(path: tuple, leaf: jax.ShapeDtypeStruct, config: ModelConfig, key: Key[Array, ""]) -> Array:
    names = [str(getattr(part, "key", "")) for part in path]
    if names[-1] == "bias":
        return jnp.zeros(leaf.shape, leaf.dtype)
    if names[-1] == "scale":
        return jnp.full(leaf.shape, 1.0 - config.norm_offset, leaf.dtype)
    added = any(name in ("attention_output", "down") for name in names)
    return jax.random.normal(key, leaf.shape, leaf.dtype) * (0.02 / (2 * config.num_layers) ** 0.5 if added else 0.02)
