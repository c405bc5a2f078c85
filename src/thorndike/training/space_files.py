"""Gymnasium spaces as JSON, so that an exported policy knows what it takes and gives without its environment."""

from typing import TypeAlias

import numpy as np
from gymnasium import spaces

from thorndike.errors import UserError

Json: TypeAlias = dict[str, object]


def space_to_json(space: spaces.Space) -> Json:
    """A space as JSON. Raises ``UserError`` for a kind that Thorndike does not know."""
    match space:
        case spaces.Discrete():
            return {"kind": "Discrete", "n": int(space.n), "start": int(space.start)}
        case spaces.MultiDiscrete():
            return {"kind": "MultiDiscrete", "nvec": space.nvec.tolist(), "start": space.start.tolist()}
        case spaces.MultiBinary():
            return {"kind": "MultiBinary", "shape": list(space.shape)}
        case spaces.Box():
            return {
                "kind": "Box",
                "low": _bound(space.low),
                "high": _bound(space.high),
                "shape": list(space.shape),
                "dtype": space.dtype.name,
            }
        case spaces.Dict():
            return {"kind": "Dict", "parts": {name: space_to_json(part) for name, part in space.spaces.items()}}
        case spaces.Tuple():
            return {"kind": "Tuple", "parts": [space_to_json(part) for part in space.spaces]}
    raise UserError(f"spaces may be Discrete, MultiDiscrete, MultiBinary, Box, Dict or Tuple; got {space}")


def space_from_json(content: Json) -> spaces.Space:
    """The space that ``space_to_json`` described. Raises ``UserError`` for an unknown kind."""
    match content:
        case {"kind": "Discrete", "n": int(n), "start": int(start)}:
            return spaces.Discrete(n, start=start)
        case {"kind": "MultiDiscrete", "nvec": list(nvec), "start": list(start)}:
            return spaces.MultiDiscrete(np.array(nvec), start=np.array(start))
        case {"kind": "MultiBinary", "shape": list(shape)}:
            return spaces.MultiBinary(tuple(shape))
        case {"kind": "Box", "low": list(low), "high": list(high), "shape": list(shape), "dtype": str(dtype)}:
            kind = np.dtype(dtype)
            return spaces.Box(_array(low, shape, kind), _array(high, shape, kind), dtype=kind.type)
        case {"kind": "Dict", "parts": dict(parts)}:
            return spaces.Dict({name: space_from_json(part) for name, part in parts.items()})
        case {"kind": "Tuple", "parts": list(parts)}:
            return spaces.Tuple([space_from_json(part) for part in parts])
    raise UserError(f"a space of unknown kind in the policy file: {content}")


def _bound(bound: np.ndarray) -> float | list:
    """One number where all are equal: the bounds of an image are not worth 28,000 numbers. Infinite bounds become text."""
    flat = np.unique(bound)
    values = flat if len(flat) == 1 else bound.ravel()
    texts = [repr(float(value)) for value in values]
    return texts if len(flat) > 1 else texts[:1]


def _array(texts: list, shape: list, dtype: np.dtype) -> np.ndarray:
    return np.broadcast_to(
        np.array([float(text) for text in texts]).astype(dtype).reshape(shape if len(texts) > 1 else (1,) * len(shape)), shape
    )
