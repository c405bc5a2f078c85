"""Rotary position embeddings: what a ``config.json`` says of them, and by how much each position turns a query or key."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import cast

import numpy as np
from jaxtyping import Float

from thorndike.errors import UserError
from thorndike.language.json_fields import Fields
from thorndike.training.json_files import Json, quoted


@dataclass(frozen=True)
class Rope:
    """Rotary position embeddings (Su et al. 2021, arXiv:2104.09864), and how their frequencies are scaled for longer texts."""

    theta: float
    kind: str = "default"
    """``default``, ``linear``, ``llama3``, or ``longrope`` within its original context."""
    factor: float = 1.0
    low_freq_factor: float = 1.0
    high_freq_factor: float = 4.0
    original_max_positions: int = 0
    divisors: tuple[float, ...] = ()
    """longrope: by what each frequency is divided."""
    magnitude: float = 1.0
    """By what cosine and sine are multiplied."""
    dimensions: int = 0
    """How many of a head's dimensions are turned."""


def read_ropes(fields: Fields, family: str, head_dim: int, positions: int) -> tuple[Rope, Rope | None, int]:
    """The rotary embedding, that of layers with a window, and the longest text they are exact for."""
    given = fields.content.get("rope_parameters")
    if given is not None and not isinstance(given, dict):
        raise UserError(f"{fields.where}: rope_parameters is {quoted(given)}, but it must be an object")
    scaling = fields.content.get("rope_scaling") or {}
    if not isinstance(scaling, dict):
        raise UserError(f"{fields.where}: rope_scaling is {quoted(scaling)}, but it must be an object")
    parameters = dict(given or {})
    theta = fields.number("rope_theta", 1e6 if family == "gemma3_text" else 1e4)
    if family != "gemma3_text":
        rope, reach = _rope({"rope_theta": theta} | parameters | scaling, fields, family, head_dim, positions)
        return rope, None, reach
    whole, local = dict(parameters.get("full_attention") or {}), dict(parameters.get("sliding_attention") or {})
    rope, reach = _rope({"rope_theta": theta} | whole | scaling, fields, family, head_dim, positions)
    local_theta = fields.number("rope_local_base_freq", 1e4)
    return rope, _rope({"rope_theta": local_theta} | local, fields, family, head_dim, positions)[0], reach


def frequencies(rope: Rope) -> Float[np.ndarray, " pairs"]:
    """How far a position turns each pair of dimensions, in radians."""
    exponents = np.arange(0, rope.dimensions, 2, dtype=np.float32) / np.float32(rope.dimensions)
    base = np.float32(rope.theta) ** exponents
    if rope.kind == "longrope":
        return (1.0 / (np.asarray(rope.divisors, np.float32) * base)).astype(np.float32)
    plain = (np.float32(1.0) / base).astype(np.float32)
    if rope.kind == "linear":
        return plain / np.float32(rope.factor)
    if rope.kind != "llama3":
        return plain
    # Long waves are stretched, short ones are not, and in between it fades: Llama 3.1's way (arXiv:2407.21783).
    wavelength = 2.0 * np.pi / plain
    share = (rope.original_max_positions / wavelength - rope.low_freq_factor) / (rope.high_freq_factor - rope.low_freq_factor)
    share = np.clip(share, 0.0, 1.0)
    return ((1.0 - share) * plain / rope.factor + share * plain).astype(np.float32)


def _rope(given: Mapping[str, object], fields: Fields, family: str, head_dim: int, positions: int) -> tuple[Rope, int]:
    inner = Fields(given, f"{fields.where}: rope")
    kind = str(given.get("rope_type") or given.get("type") or "default")
    if family == "phi3" and kind in ("su", "yarn"):
        kind = "longrope"
    partial = inner.number("partial_rotary_factor", fields.number("partial_rotary_factor", 1.0))
    if family != "phi3" and partial != 1.0:
        raise UserError(f"{fields.where}: partial_rotary_factor {partial} of {family} is not supported, only 1.0")
    dimensions, theta = int(head_dim * partial), inner.number("rope_theta")
    if kind == "default":
        return Rope(theta, dimensions=dimensions), positions
    if kind == "dynamic":
        # Its frequencies change with the longest text of a batch, but only beyond the trained length.
        return Rope(theta, dimensions=dimensions), positions
    if kind == "linear":
        return Rope(theta, kind, inner.number("factor"), dimensions=dimensions), positions
    original = fields.content.get("original_max_position_embeddings") or given.get("original_max_position_embeddings") or positions
    if type(original) is not int:
        raise UserError(f"{fields.where}: original_max_position_embeddings is {quoted(original)}, but it must be a whole number")
    if kind == "llama3":
        low, high = inner.number("low_freq_factor"), inner.number("high_freq_factor")
        return Rope(theta, kind, inner.number("factor"), low, high, original, dimensions=dimensions), positions
    if kind == "longrope":
        return _longrope(inner, theta, dimensions, original, positions), original
    raise UserError(f"{fields.where}: rope_type {kind!r} is not supported; supported: default, linear, dynamic, llama3, longrope")


def _longrope(inner: Fields, theta: float, dimensions: int, original: int, positions: int) -> Rope:
    """The short factors: beyond the original context transformers turns *all* of a batch's tokens by others, so that is refused."""
    divisors = inner.content.get("short_factor")
    if not isinstance(divisors, list) or len(divisors) != dimensions // 2:
        raise UserError(f"{inner.where}: short_factor is {quoted(divisors)}, but it must be a list of {dimensions // 2} numbers")
    factor = inner.number("factor", positions / original)
    magnitude = inner.number("attention_factor", 1.0 if factor <= 1.0 else math.sqrt(1.0 + math.log(factor) / math.log(original)))
    short = tuple(float(each) for each in divisors)
    return Rope(theta, "longrope", original_max_positions=original, divisors=short, magnitude=magnitude, dimensions=dimensions)


def both_rope_keys(content: Json) -> Json:
    """Transformers 4 reads ``rope_theta`` and ``rope_scaling``, transformers 5 ``rope_parameters``."""
    given = content.get("rope_parameters")
    if not isinstance(given, dict):
        return {}
    if "full_attention" in given or "sliding_attention" in given:
        whole, local = (cast(Json, given.get(kind) or {}) for kind in ("full_attention", "sliding_attention"))
        theirs = {"rope_theta": whole.get("rope_theta"), "rope_local_base_freq": local.get("rope_theta")}
        return {key: value for key, value in theirs.items() if value is not None} | _old_scaling(whole)
    partial = {"partial_rotary_factor": given["partial_rotary_factor"]} if "partial_rotary_factor" in given else {}
    return ({"rope_theta": given["rope_theta"]} if "rope_theta" in given else {}) | partial | _old_scaling(given)


def _old_scaling(given: Mapping[str, object]) -> Json:
    if given.get("rope_type", "default") == "default":
        return {}
    kept = {key: value for key, value in given.items() if key not in ("rope_theta", "partial_rotary_factor")}
    return {"rope_scaling": kept | {"type": given["rope_type"]}}
