"""The keys of a model's ``config.json``, read with suspicion."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Literal, TypeAlias

from thorndike.errors import UserError
from thorndike.training.json_files import quoted

Dtype: TypeAlias = Literal["float32", "bfloat16"]

_ACTIVATIONS = {
    "silu": "silu", "swish": "silu", "gelu": "gelu", "gelu_new": "gelu_tanh", "gelu_pytorch_tanh": "gelu_tanh", "gelu_fast": "gelu_tanh",
    "relu": "relu",
}  # fmt: skip
"""Transformers' names of activations, and ours."""


class Fields:
    """The keys of a config, read with suspicion."""

    def __init__(self, content: Mapping[str, object], where: str | Path) -> None:
        self.content, self.where = content, where

    def whole(self, name: str, default: int | None = None) -> int:
        """A whole number of at least 1. Raises ``UserError`` for anything else, also for nothing where there is no default."""
        value = self.content.get(name)
        if value is None and default is not None:
            return default
        if type(value) is not int or value < 1:
            raise UserError(f"{self.where}: {name} is {quoted(value)}, but it must be a whole number of at least 1")
        return value

    def number(self, name: str, default: float | None = None) -> float:
        """A finite number; as ``whole``."""
        value = self.content.get(name)
        if value is None and default is not None:
            return default
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise UserError(f"{self.where}: {name} is {quoted(value)}, but it must be a number")
        return float(value)

    def optional(self, name: str) -> float | None:
        """A number, or None where there is none."""
        return None if self.content.get(name) is None else self.number(name)

    def flag(self, name: str, default: bool) -> bool:
        """True or false."""
        value = self.content.get(name)
        if value is None:
            return default
        if not isinstance(value, bool):
            raise UserError(f"{self.where}: {name} is {quoted(value)}, but it must be true or false")
        return value

    def token(self, name: str) -> int | None:
        """The number of a token, None for whatever is none."""
        value = self.content.get(name)
        return value if type(value) is int and value >= 0 else None

    def activation(self, name: str, default: str) -> str:
        """Our name of an activation. Raises ``UserError`` for one that the decoder does not have."""
        value = self.content.get(name) or default
        if value not in _ACTIVATIONS:
            raise UserError(f"{self.where}: {name} {quoted(value)} is not supported; supported: {', '.join(_ACTIVATIONS)}")
        return _ACTIVATIONS[str(value)]

    def dtype(self) -> Dtype:
        """In which precision the model computes; float16 is read as float32."""
        value = self.content.get("dtype") or self.content.get("torch_dtype") or "float32"
        if value in ("float16", "float64"):
            return "float32"
        if value not in ("float32", "bfloat16"):
            raise UserError(
                f"{self.where}: dtype {quoted(value)} is not supported; supported: float32, bfloat16, float16 (read as float32)"
            )
        return value

    def number_of_labels(self) -> int:
        """Of a model with a head: by their names, or their number."""
        labels = self.content.get("id2label")
        return len(labels) if isinstance(labels, dict) else self.whole("num_labels", 2)

    def refuse(self, name: str, expected: object) -> None:
        """Raises where a key asks for what the decoder does not do."""
        value = self.content.get(name)
        if value is not None and value != expected:
            raise UserError(f"{self.where}: {name} = {quoted(value)} is not supported, only {expected!r}")
