"""A Hugging Face ``config.json`` as an immutable description of the decoder, and back.

Keys of transformers 4 and 5 are read; what is written has both, so that older programs load it too. Whatever the decoder would not compute
exactly as transformers does is refused in one line: nothing is guessed.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

from thorndike.errors import UserError
from thorndike.language.json_fields import Dtype, Fields
from thorndike.language.rope import Rope, both_rope_keys, read_ropes
from thorndike.suggestions import did_you_mean
from thorndike.training.json_files import Json, as_bytes, quoted, read_object

FAMILIES = ("gpt2", "llama", "mistral", "qwen2", "qwen3", "gemma2", "gemma3_text", "phi3")
"""``model_type`` of what can be read."""

_TIED = {"gpt2": True, "gemma2": True, "gemma3_text": True}
"""Families whose output layer is the embedding unless the config says otherwise."""
_EPSILON = {"gpt2": 1e-5, "phi3": 1e-5}
_CLASS_NAMES = {
    "gpt2": "GPT2", "llama": "Llama", "mistral": "Mistral", "qwen2": "Qwen2", "qwen3": "Qwen3", "gemma2": "Gemma2",
    "gemma3_text": "Gemma3Text", "phi3": "Phi3",
}  # fmt: skip


@dataclass(frozen=True)
class ModelConfig:
    """A decoder-only transformer. Everything that its computation depends on; hashable, so that it may be static under ``jit``."""

    model_type: str
    vocab_size: int
    hidden_size: int
    intermediate_size: int
    num_layers: int
    num_heads: int
    num_kv_heads: int
    head_dim: int
    max_positions: int
    """The longest text whose logits are exact."""
    activation: str = "silu"
    gated: bool = True
    """Whether the feed-forward layer is ``activation(gate) * up``."""
    layer_norm: bool = False
    """LayerNorm with bias instead of RMSNorm."""
    norm_eps: float = 1e-6
    norm_offset: float = 0.0
    """Added to the norms' weights."""
    sandwich_norms: bool = False
    """A norm after attention and feed-forward layers as well as before them."""
    qk_norm: bool = False
    qkv_bias: bool = False
    output_bias: bool = False
    mlp_bias: bool = False
    query_scale: float = 1.0
    """By what attention scores are multiplied."""
    attention_soft_cap: float | None = None
    logit_soft_cap: float | None = None
    embedding_scale: float = 1.0
    tied: bool = False
    """Whether the output layer is the embedding."""
    rope: Rope | None = None
    local_rope: Rope | None = None
    """That of layers with a window, where it differs."""
    windows: tuple[int | None, ...] = ()
    """By layer: how many tokens back, itself included, a token sees; None: all."""
    dtype: Dtype = "float32"
    num_labels: int | None = None
    """1 for a model with a scalar head, None for one that predicts tokens."""
    bos_token_id: int | None = None
    eos_token_ids: tuple[int, ...] = ()
    pad_token_id: int | None = None
    never_chosen: tuple[int, ...] = ()
    """Tokens of probability 0: what is left is the model's distribution, wherever there is one. Not part of the files."""
    source: str = "{}"
    """The JSON it was read from: written back with what has changed."""


def read_model_config(folder: Path) -> ModelConfig:
    """The config of a model's folder. Raises ``UserError`` where there is none, or what it asks for is not supported."""
    path = folder / "config.json"
    try:
        content = read_object(path)
    except FileNotFoundError:
        raise UserError(f"{folder} is no model: it has no config.json; give a folder as transformers' save_pretrained writes it") from None
    return parse_model_config(content, path)


def parse_model_config(content: Mapping[str, object], where: str | Path = "config") -> ModelConfig:
    """A config from the keys of a ``config.json``. Raises ``UserError`` for what is missing or not supported."""
    fields = Fields(content, where)
    model_type = content.get("model_type")
    if model_type not in FAMILIES:
        hint = did_you_mean(str(model_type), FAMILIES) or f"; supported: {', '.join(FAMILIES)}"
        raise UserError(f"{where}: model_type {quoted(model_type)} is not supported{hint}")
    config = _gpt2(fields) if model_type == "gpt2" else _rotary(fields, str(model_type))
    architectures = content.get("architectures")
    scalar = isinstance(architectures, list) and any(str(name).endswith("ForSequenceClassification") for name in architectures)
    if scalar and fields.number_of_labels() != 1:
        raise UserError(f"{where}: num_labels is {fields.number_of_labels()}; only models with one score are supported: num_labels 1")
    end = content.get("eos_token_id")
    return replace(
        config,
        tied=fields.flag("tie_word_embeddings", _TIED.get(str(model_type), False)),
        dtype=fields.dtype(),
        num_labels=1 if scalar else None,
        bos_token_id=fields.token("bos_token_id"),
        eos_token_ids=tuple(int(each) for each in end) if isinstance(end, list) else () if end is None else (int(cast(int, end)),),
        pad_token_id=fields.token("pad_token_id"),
        source=json.dumps(content),
    )


def as_json(config: ModelConfig) -> Json:
    """The keys of ``config.json``, those of transformers 4 beside those of 5."""
    content: Json = json.loads(config.source)
    kind = "ForSequenceClassification" if config.num_labels else "LMHeadModel" if config.model_type == "gpt2" else "ForCausalLM"
    name = "Gemma3" if config.model_type == "gemma3_text" and not config.num_labels else _CLASS_NAMES[config.model_type]
    content["architectures"] = [name + kind]
    content |= {"dtype": config.dtype, "torch_dtype": config.dtype, "tie_word_embeddings": config.tied, "vocab_size": config.vocab_size}
    ends = list(config.eos_token_ids)
    content |= {"bos_token_id": config.bos_token_id, "eos_token_id": ends[0] if len(ends) == 1 else ends or None}
    content["pad_token_id"] = config.pad_token_id
    if config.num_labels:
        # Transformers counts labels by their names; it writes them instead of num_labels.
        content |= {"num_labels": 1, "id2label": {"0": "LABEL_0"}, "label2id": {"LABEL_0": 0}}
    else:
        for key in ("num_labels", "id2label", "label2id"):
            content.pop(key, None)
    return content | both_rope_keys(content)


def write_model_config(config: ModelConfig, folder: Path) -> None:
    """Write ``config.json``."""
    (folder / "config.json").write_bytes(as_bytes(as_json(config)))


def with_dtype(config: ModelConfig, dtype: Dtype) -> ModelConfig:
    """The same model computing in another precision."""
    return replace(config, dtype=dtype)


def _gpt2(fields: Fields) -> ModelConfig:
    for name, expected in {
        "scale_attn_weights": True,
        "scale_attn_by_inverse_layer_idx": False,
        "reorder_and_upcast_attn": False,
        "add_cross_attention": False,
    }.items():
        fields.refuse(name, expected)
    hidden, heads, layers = fields.whole("n_embd"), fields.whole("n_head"), fields.whole("n_layer")
    return ModelConfig(
        model_type="gpt2",
        vocab_size=fields.whole("vocab_size"),
        hidden_size=hidden,
        intermediate_size=fields.whole("n_inner", 4 * hidden),
        num_layers=layers,
        num_heads=heads,
        num_kv_heads=heads,
        head_dim=hidden // heads,
        max_positions=fields.whole("n_positions", 1024),
        activation=fields.activation("activation_function", "gelu_new"),
        gated=False,
        layer_norm=True,
        norm_eps=fields.number("layer_norm_epsilon", 1e-5),
        qkv_bias=True,
        output_bias=True,
        mlp_bias=True,
        query_scale=(hidden // heads) ** -0.5,
        windows=(None,) * layers,
    )


def _rotary(fields: Fields, family: str) -> ModelConfig:
    """Every family but GPT-2: Llama's architecture with variations."""
    gemma = family.startswith("gemma")
    hidden, heads, layers = (fields.whole(name) for name in ("hidden_size", "num_attention_heads", "num_hidden_layers"))
    # Where transformers' own default is a number that fits one model only, the config must say it.
    kv_heads = fields.whole("num_key_value_heads", heads if family in ("llama", "phi3") else None)
    head_dim = fields.whole("head_dim", {"qwen3": 128, "gemma2": 256, "gemma3_text": 256}.get(family, hidden // heads))
    if heads % kv_heads:
        raise UserError(f"{fields.where}: {heads} attention heads do not share {kv_heads} key-value heads evenly")
    if gemma:
        fields.refuse("use_bidirectional_attention", False)
    if family == "llama":
        fields.refuse("pretraining_tp", 1)
    positions = fields.whole("max_position_embeddings", 2048 if family == "llama" else None)
    rope, local, reach = read_ropes(fields, family, head_dim, positions)
    bias = fields.flag("attention_bias", False) if family in ("llama", "qwen3") or gemma else False
    return ModelConfig(
        model_type=family,
        vocab_size=fields.whole("vocab_size"),
        hidden_size=hidden,
        intermediate_size=fields.whole("intermediate_size"),
        num_layers=layers,
        num_heads=heads,
        num_kv_heads=kv_heads,
        head_dim=head_dim,
        max_positions=reach,
        activation=fields.activation("hidden_activation" if gemma else "hidden_act", "gelu_pytorch_tanh" if gemma else "silu"),
        norm_eps=fields.number("rms_norm_eps", _EPSILON.get(family, 1e-6)),
        norm_offset=1.0 if gemma else 0.0,
        sandwich_norms=gemma,
        qk_norm=family in ("qwen3", "gemma3_text"),
        qkv_bias=bias or family == "qwen2",
        output_bias=bias,
        mlp_bias=fields.flag("mlp_bias", False) if family == "llama" else False,
        query_scale=(fields.number("query_pre_attn_scalar", 256.0) if gemma else head_dim) ** -0.5,
        # Transformers' Gemma 3 reads a cap of attention scores from its config, and does not apply it.
        attention_soft_cap=_cap(fields, "attn_logit_softcapping", 50.0) if family == "gemma2" else None,
        logit_soft_cap=_cap(fields, "final_logit_softcapping", 30.0 if family == "gemma2" else None) if gemma else None,
        embedding_scale=hidden**0.5 if gemma else 1.0,
        rope=rope,
        local_rope=local,
        windows=_windows(fields, family, layers),
    )


def _cap(fields: Fields, name: str, default: float | None) -> float | None:
    return fields.optional(name) if name in fields.content else default


def _windows(fields: Fields, family: str, layers: int) -> tuple[int | None, ...]:
    """How far each layer sees."""
    window = fields.content.get("sliding_window", {"mistral": 4096, "gemma2": 4096, "gemma3_text": 4096}.get(family))
    if family == "llama" or window is None or (family.startswith("qwen") and not fields.flag("use_sliding_window", False)):
        return (None,) * layers
    width = fields.whole("sliding_window", int(cast(int, window)))
    if family in ("mistral", "phi3"):
        return (width,) * layers
    kinds = fields.content.get("layer_types")
    if kinds is None:
        kinds = _layer_kinds(fields, family, layers)
    if not isinstance(kinds, list) or len(kinds) != layers or not set(kinds) <= {"sliding_attention", "full_attention"}:
        raise UserError(f"{fields.where}: layer_types is {quoted(kinds)}, but it must say sliding_attention or full_attention a layer")
    return tuple(width if kind == "sliding_attention" else None for kind in kinds)


def _layer_kinds(fields: Fields, family: str, layers: int) -> list[str]:
    """Which layers have a window where a config of transformers 4 does not list them."""
    if family.startswith("qwen"):
        first = fields.whole("max_window_layers", 28) if fields.content.get("max_window_layers") != 0 else 0
        return ["sliding_attention" if number >= first else "full_attention" for number in range(layers)]
    every = 2 if family == "gemma2" else fields.whole("sliding_window_pattern", 6)
    return ["sliding_attention" if (number + 1) % every else "full_attention" for number in range(layers)]
