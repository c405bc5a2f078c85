"""Low-rank adapters (LoRA, Hu et al. 2021, arXiv:2106.09685) in PEFT's file format, and merging them into the parameters.

An adapter is merged at the beginning of every forward pass: that costs rank / rows of a matrix product, and the decoder knows nothing of
adapters. Gradients are taken of the small matrices only.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from thorndike.errors import UserError
from thorndike.language.decoder import Params, param_shapes
from thorndike.language.json_fields import Fields
from thorndike.language.model_config import ModelConfig
from thorndike.language.weights import Weight, part_at, weight_table
from thorndike.suggestions import did_you_mean
from thorndike.training.json_files import as_bytes, quoted, read_object

CONFIG, ARRAYS = "adapter_config.json", "adapter_model.safetensors"
_PREFIX = "base_model.model."


class Pair(NamedTuple):
    """What is added to one matrix: ``scale * down @ up``."""

    down: Float[Array, "n r"]
    up: Float[Array, "r m"]


LowRank: TypeAlias = Mapping[str, Pair]
"""By the module's name in transformers: ``model.layers.0.self_attn.q_proj``."""


@dataclass(frozen=True)
class LoraConfig:
    """Which matrices are adapted, and how strongly."""

    rank: int = 16  # r
    alpha: float = 32.0  # the sum's scale is alpha / r
    target_modules: tuple[str, ...] = ()  # last parts of module names; all matrices of the layers if empty
    rank_stabilised: bool = False  # alpha / sqrt(r) (Kalajdzievski 2023, arXiv:2312.03732)

    def scale(self, rank: int) -> float:
        """By what a product of that rank is multiplied."""
        return self.alpha / (math.sqrt(rank) if self.rank_stabilised else rank)


class Adapter(NamedTuple):
    """Low-rank matrices and their settings."""

    lora: LoraConfig
    pairs: LowRank


def initial_adapter(config: ModelConfig, lora: LoraConfig, key: Key[Array, ""]) -> Adapter:
    """An adapter that changes nothing yet: the second matrix is 0. Consumes the key. Raises ``UserError`` for an unknown target."""
    modules, shapes = _modules(config), param_shapes(config)
    known = sorted({name.rpartition(".")[2] for name in modules})
    for target in lora.target_modules:
        if target not in known:
            raise UserError(f"{config.model_type} has no module '{target}' to adapt{did_you_mean(target, known) or f'; it has {known}'}")
    chosen = {name: each for name, each in modules.items() if not lora.target_modules or name.rpartition(".")[2] in lora.target_modules}
    pairs = {}
    for (name, weight), k in zip(chosen.items(), jax.random.split(key, len(chosen)), strict=True):
        rows, columns = part_at(shapes, weight.path).shape
        width = len(range(*weight.columns.indices(columns)))
        bound = rows**-0.5
        down = jax.random.uniform(k, (rows, lora.rank), minval=-bound, maxval=bound)
        pairs[name] = Pair(down, jnp.zeros((lora.rank, width)))
    return Adapter(lora, pairs)


def merged(params: Params, config: ModelConfig, adapter: Adapter) -> Params:
    """The parameters with the adapter added to them."""
    modules = _modules(config)
    layers = [{name: dict(part) for name, part in layer.items()} for layer in params["layers"]]
    for name, pair in adapter.pairs.items():
        weight = modules[name]
        place = part_at(layers, weight.path[1:-1])
        kernel = jnp.asarray(place["kernel"])
        added = adapter.lora.scale(pair.down.shape[1]) * (pair.down @ pair.up)
        place["kernel"] = kernel.at[:, weight.columns].add(added.astype(kernel.dtype))
    return {**params, "layers": tuple(layers)}


def load_adapter(folder: Path, config: ModelConfig) -> Adapter:
    """An adapter as PEFT writes it. Raises ``UserError`` for what is missing, not supported or made for another model."""
    where = folder / CONFIG
    try:
        content = read_object(where)
    except FileNotFoundError:
        raise UserError(f"{folder} is no adapter: it has no {CONFIG}") from None
    fields = Fields(content, where)
    for name, expected in {"peft_type": "LORA", "bias": "none", "use_dora": False, "lora_bias": False, "layer_replication": None}.items():
        fields.refuse(name, expected)
    for name in ("modules_to_save", "alpha_pattern", "trainable_token_indices", "target_parameters"):
        if content.get(name):
            raise UserError(f"{where}: {name} = {quoted(content[name])} is not supported; leave it out")
    rank, alpha = fields.whole("r"), fields.number("lora_alpha")
    try:
        arrays = load_file(folder / ARRAYS)
    except (SafetensorError, OSError) as error:
        raise UserError(f"{folder / ARRAYS} cannot be read: {error}") from error
    pairs = _read_pairs(arrays, config, folder / ARRAYS)
    targets = tuple(sorted({name.rpartition(".")[2] for name in pairs}))
    return Adapter(LoraConfig(rank, alpha, targets, fields.flag("use_rslora", False)), pairs)


def save_adapter(adapter: Adapter, config: ModelConfig, folder: Path, base_model: str | None = None) -> None:
    """Write the adapter as PEFT reads it; ``base_model``: the folder or hub name of the model it belongs to."""
    folder.mkdir(parents=True, exist_ok=True)
    lora = adapter.lora
    ranks = {name: pair.down.shape[1] for name, pair in adapter.pairs.items() if pair.down.shape[1] != lora.rank}
    content = {
        "peft_type": "LORA",
        "task_type": "SEQ_CLS" if config.num_labels else "CAUSAL_LM",
        "base_model_name_or_path": base_model,
        "r": lora.rank,
        "lora_alpha": lora.alpha,
        "lora_dropout": 0.0,
        "target_modules": sorted({name.rpartition(".")[2] for name in adapter.pairs}),
        "rank_pattern": ranks,
        "use_rslora": lora.rank_stabilised,
        "fan_in_fan_out": config.model_type == "gpt2",
        "bias": "none",
        "inference_mode": True,
    }
    arrays = {}
    for name, pair in adapter.pairs.items():
        arrays[f"{_PREFIX}{name}.lora_A.weight"] = np.ascontiguousarray(np.asarray(pair.down).T)
        arrays[f"{_PREFIX}{name}.lora_B.weight"] = np.ascontiguousarray(np.asarray(pair.up).T)
    (folder / CONFIG).write_bytes(as_bytes(content))
    save_file(arrays, folder / ARRAYS, metadata={"format": "pt"})


def _modules(config: ModelConfig) -> dict[str, Weight]:
    """The matrices of the layers, by transformers' names of their modules."""
    table = weight_table(config)
    return {weight.name.removesuffix(".weight"): weight for weight in table if weight.path[0] == "layers" and weight.path[-1] == "kernel"}


def _read_pairs(arrays: Mapping[str, np.ndarray], config: ModelConfig, where: Path) -> dict[str, Pair]:
    modules, shapes = _modules(config), param_shapes(config)
    pairs = {}
    for key in arrays:
        name, dot, kind = key.removeprefix(_PREFIX).rpartition(".lora_")
        if not dot or name not in modules or kind not in ("A.weight", "B.weight"):
            raise UserError(f"{where}: {key!r} adapts nothing that this {config.model_type} has, or nothing that is supported")
        first, second = (arrays.get(f"{_PREFIX}{name}.lora_{half}.weight") for half in "AB")
        rows, columns = part_at(shapes, modules[name].path).shape
        width = len(range(*modules[name].columns.indices(columns)))
        if first is None or second is None or first.shape != (second.shape[1], rows) or second.shape[0] != width:
            raise UserError(f"{where}: the matrices of {name} do not fit one of {rows} x {width}: the adapter belongs to another model")
        pairs[name] = Pair(jnp.asarray(first.T), jnp.asarray(second.T))
    return pairs
