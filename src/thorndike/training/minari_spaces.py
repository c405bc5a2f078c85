"""Gymnasium spaces in the JSON that Minari keeps them in: texts of numbers, so that Minari reads what is written here, and the reverse."""

import json
from typing import cast

import numpy as np
from gymnasium import spaces

from thorndike.errors import UserError
from thorndike.training.json_files import Json, quoted


def space_text(space: spaces.Space) -> str:
    """A space as Minari writes it. Raises ``UserError`` for a kind that Thorndike does not know."""
    return json.dumps(_described(space))


def space_of_text(text: object, where: object) -> spaces.Space:
    """The space that Minari wrote. Raises ``UserError``, naming the file ``where``, for anything else."""
    try:
        return _space(json.loads(cast(str, text)))
    except (KeyError, TypeError, ValueError, AssertionError) as error:
        raise UserError(f"{where} is damaged: {quoted(text)} is no space ({type(error).__name__}: {str(error)[:80]})") from error


def is_encoded_image(space: spaces.Space) -> bool:
    """Whether Minari may keep this space as JPEG pictures."""
    if not isinstance(space, spaces.Box) or space.dtype != np.uint8 or len(space.shape) not in (2, 3):
        return False
    return min(space.shape[:2]) >= 32 and bool((space.low == 0).all()) and bool((space.high == 255).all())


def _described(space: spaces.Space) -> Json:
    match space:
        case spaces.Discrete():
            return {"type": "Discrete", "dtype": "int64", "start": int(space.start), "n": int(space.n)}
        case spaces.MultiDiscrete():
            facts = {"type": "MultiDiscrete", "dtype": str(space.dtype)}
            return {**facts, "nvec": space.nvec.tolist(), "start": space.start.tolist()}
        case spaces.MultiBinary():
            return {"type": "MultiBinary", "n": int(space.n) if isinstance(space.n, int | np.integer) else list(space.shape)}
        case spaces.Box():
            facts = {"type": "Box", "dtype": str(space.dtype)}
            return {**facts, "shape": list(space.shape), "low": space.low.tolist(), "high": space.high.tolist()}
        case spaces.Dict():
            return {"type": "Dict", "subspaces": {name: _described(part) for name, part in space.spaces.items()}}
        case spaces.Tuple():
            return {"type": "Tuple", "subspaces": [_described(part) for part in space.spaces]}
    raise UserError(f"a dataset holds Discrete, MultiDiscrete, MultiBinary, Box, Dict or Tuple spaces; got {space}")


def _space(content: dict) -> spaces.Space:
    match content["type"]:
        case "Discrete":
            return spaces.Discrete(content["n"], start=content["start"])
        case "MultiDiscrete":
            return spaces.MultiDiscrete(np.array(content["nvec"]), start=np.array(content["start"]))
        case "MultiBinary":
            return spaces.MultiBinary(content["n"])
        case "Box":
            kind = np.dtype(content["dtype"])
            low, high = (np.array(content[bound], kind).reshape(content["shape"]) for bound in ("low", "high"))
            return spaces.Box(low, high, dtype=kind.type)
        case "Dict":
            return spaces.Dict({name: _space(part) for name, part in content["subspaces"].items()})
        case "Tuple":
            return spaces.Tuple([_space(part) for part in content["subspaces"]])
    raise ValueError(f"of the unknown type {quoted(content['type'])}")
