"""Parameters as transformers' safetensors, both ways: one file or shards with an index, float32 or bfloat16, names by family.

``weight_table`` says of every array of a checkpoint which part of our parameters it is; query, key and value projections are columns of one
matrix here, and so are gate and up.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from thorndike.errors import UserError
from thorndike.language.decoder import Params, param_shapes
from thorndike.language.model_config import ModelConfig
from thorndike.training.json_files import as_bytes, read_object

SINGLE, INDEX = "model.safetensors", "model.safetensors.index.json"
SHARD = 5 * 10**9
"""Bytes of a file at most, as transformers writes them."""


class Weight(NamedTuple):
    """Where an array of a checkpoint is in our parameters."""

    name: str
    path: tuple[str | int, ...]
    columns: slice = slice(None)
    """Of the last axis."""
    transposed: bool = False


def weight_table(config: ModelConfig) -> list[Weight]:
    """All arrays of a family's checkpoint, in its order."""
    return list(_gpt2_table(config) if config.model_type == "gpt2" else _rotary_table(config))


def load_params(folder: Path, config: ModelConfig) -> Params:
    """The parameters in a model's folder, in the config's precision. Raises ``UserError`` for what is missing or of another shape."""
    dtype, shapes = jnp.dtype(config.dtype), param_shapes(config)
    arrays = jax.tree.map(lambda shape: np.full(shape.shape, np.nan, dtype), shapes)
    files = _files(folder)
    names = {name: file for file in files for name in _names(file)}
    by_file: dict[Path, list[tuple[Weight, str]]] = {}
    for weight in weight_table(config):
        name = next((name for name in _spellings(weight.name) if name in names), None)
        if name is None:
            hint = "; it is a model without a scalar head" if weight.path[0] == "score" else ""
            raise UserError(f"{folder} has no array {weight.name!r}, which a {config.model_type} with this config.json has{hint}")
        by_file.setdefault(names[name], []).append((weight, name))
    for file, wanted in by_file.items():
        _read(file, wanted, arrays)
    return jax.tree.map(jnp.asarray, arrays)


def save_params(params: Params, config: ModelConfig, folder: Path, shard_bytes: int = SHARD) -> None:
    """Write the parameters with transformers' names, in the config's precision; several files and an index above ``shard_bytes``."""
    dtype = jnp.dtype(config.dtype)
    shards: list[dict[str, np.ndarray]] = [{}]
    for weight in weight_table(config):
        array = checkpoint_array(params, weight).astype(dtype)
        if shards[-1] and sum(each.nbytes for each in shards[-1].values()) + array.nbytes > shard_bytes:
            shards.append({})
        shards[-1][weight.name] = array
    if len(shards) == 1:
        save_file(shards[0], folder / SINGLE, metadata={"format": "pt"})
        return
    names = {f"model-{number:05}-of-{len(shards):05}.safetensors": shard for number, shard in enumerate(shards, 1)}
    for name, shard in names.items():
        save_file(shard, folder / name, metadata={"format": "pt"})
    total = sum(array.nbytes for shard in shards for array in shard.values())
    places = {key: name for name, shard in names.items() for key in shard}
    (folder / INDEX).write_bytes(as_bytes({"metadata": {"total_size": total}, "weight_map": places}))


def checkpoint_array(params: Params, weight: Weight) -> np.ndarray:
    """One array as the checkpoint has it."""
    array = np.asarray(part_at(params, weight.path))[..., weight.columns]
    return np.ascontiguousarray(array.T if weight.transposed else array)


def part_at(params: Params, path: tuple[str | int, ...]) -> np.ndarray:
    """The array at a path."""
    found: PyTree = params
    for step in path:
        found = found[step]
    return found


def _read(file: Path, wanted: list[tuple[Weight, str]], arrays: PyTree) -> None:
    try:
        with safe_open(file, framework="numpy") as opened:
            for weight, name in wanted:
                found = opened.get_tensor(name)
                into = part_at(arrays, weight.path)[..., weight.columns]
                found = found.T if weight.transposed else found
                if found.shape != into.shape:
                    raise UserError(f"{file}: {name} has shape {found.shape}, but with this config.json it would have {into.shape}")
                into[...] = found.astype(into.dtype)
    except (SafetensorError, OSError) as error:
        raise UserError(f"{file} cannot be read: {error}") from error


def _files(folder: Path) -> list[Path]:
    """The files that hold the parameters."""
    if (folder / SINGLE).is_file():
        return [folder / SINGLE]
    try:
        places = read_object(folder / INDEX).get("weight_map")
    except FileNotFoundError:
        old = next(iter(sorted(folder.glob("*.bin"))), None)
        hint = f"; {old.name} is a pickle, which is never read: save it as safetensors with transformers first" if old else ""
        raise UserError(f"{folder} has no {SINGLE}, and no {INDEX}{hint}") from None
    if not isinstance(places, Mapping) or not all(isinstance(name, str) and Path(name).name == name for name in places.values()):
        raise UserError(f"{folder / INDEX} is damaged: weight_map must say of every array in which file of this folder it is")
    return sorted({folder / str(name) for name in places.values()})


def _names(file: Path) -> list[str]:
    try:
        with safe_open(file, framework="numpy") as opened:
            return list(opened.keys())
    except (SafetensorError, OSError) as error:
        raise UserError(f"{file} cannot be read: {error}") from error


def _spellings(name: str) -> list[str]:
    """A name, and as GPT-2's own checkpoints have it, without the first part."""
    return [name, name.removeprefix("transformer.")]


def _gpt2_table(config: ModelConfig) -> Iterator[Weight]:
    yield Weight("transformer.wte.weight", ("embedding",))
    yield Weight("transformer.wpe.weight", ("positions",))
    parts = {"attn.c_attn": "qkv", "attn.c_proj": "attention_output", "mlp.c_fc": "up", "mlp.c_proj": "down"}
    for number in range(config.num_layers):
        theirs = f"transformer.h.{number}."
        for name, part in {"ln_1": "attention_norm", "ln_2": "mlp_norm"}.items():
            yield Weight(f"{theirs}{name}.weight", ("layers", number, part, "scale"))
            yield Weight(f"{theirs}{name}.bias", ("layers", number, part, "bias"))
        for name, part in parts.items():
            yield Weight(f"{theirs}{name}.weight", ("layers", number, part, "kernel"))
            yield Weight(f"{theirs}{name}.bias", ("layers", number, part, "bias"))
    yield Weight("transformer.ln_f.weight", ("norm", "scale"))
    yield Weight("transformer.ln_f.bias", ("norm", "bias"))
    yield from _heads(config)


def _rotary_table(config: ModelConfig) -> Iterator[Weight]:
    yield Weight("model.embed_tokens.weight", ("embedding",))
    for number in range(config.num_layers):
        theirs = f"model.layers.{number}."
        for name, part, columns, bias in _projections(config):
            yield Weight(f"{theirs}{name}.weight", ("layers", number, part, "kernel"), columns, transposed=True)
            if bias:
                yield Weight(f"{theirs}{name}.bias", ("layers", number, part, "bias"), columns)
        for name, part in _norms(config).items():
            yield Weight(f"{theirs}{name}.weight", ("layers", number, part, "scale"))
    yield Weight("model.norm.weight", ("norm", "scale"))
    yield from _heads(config)


def _projections(config: ModelConfig) -> Iterator[tuple[str, str, slice, bool]]:
    """Their name, our part of a layer, its columns, whether there is a bias."""
    query, kv, inner = config.num_heads * config.head_dim, config.num_kv_heads * config.head_dim, config.intermediate_size
    if config.model_type == "phi3":
        yield "self_attn.qkv_proj", "qkv", slice(None), False
        yield "mlp.gate_up_proj", "up", slice(None), False
    else:
        yield "self_attn.q_proj", "qkv", slice(0, query), config.qkv_bias
        yield "self_attn.k_proj", "qkv", slice(query, query + kv), config.qkv_bias
        yield "self_attn.v_proj", "qkv", slice(query + kv, None), config.qkv_bias
        yield "mlp.gate_proj", "up", slice(0, inner), config.mlp_bias
        yield "mlp.up_proj", "up", slice(inner, None), config.mlp_bias
    yield "self_attn.o_proj", "attention_output", slice(None), config.output_bias
    yield "mlp.down_proj", "down", slice(None), config.mlp_bias


def _norms(config: ModelConfig) -> dict[str, str]:
    norms = {"input_layernorm": "attention_norm"}
    if config.sandwich_norms:
        norms |= {"post_attention_layernorm": "attention_post_norm", "pre_feedforward_layernorm": "mlp_norm"}
        norms |= {"post_feedforward_layernorm": "mlp_post_norm"}
    else:
        norms |= {"post_attention_layernorm": "mlp_norm"}
    return norms | ({"self_attn.q_norm": "query_norm", "self_attn.k_norm": "key_norm"} if config.qk_norm else {})


def _heads(config: ModelConfig) -> Iterator[Weight]:
    if config.num_labels:
        yield Weight("score.weight", ("score", "kernel"), transposed=True)
    elif not config.tied:
        yield Weight("lm_head.weight", ("output", "kernel"))
