"""Whether an observation is what its space says, leaf by leaf of a Dict or Tuple."""

import hashlib
from collections.abc import Mapping
from typing import NamedTuple, NoReturn, TypeAlias

import gymnasium
import numpy as np
from gymnasium import spaces

from thorndike.environments.checking.findings import CannotGoOn, Findings
from thorndike.environments.host.arrays import PLAIN_SPACES, array_dtype

WHOLE_BYTES = 4096
"""Leaves up to this size are kept as they are, larger ones as a digest."""

Key: TypeAlias = tuple[bytes, ...]
"""An observation in a form to compare and to look up, one part a leaf."""


class Leaf(NamedTuple):
    """One array of an observation."""

    path: str
    """As it is written in Python: ``observation['camera'][0]``."""
    space: gymnasium.Space
    value: object
    """As the environment returned it."""
    array: np.ndarray


def read_leaves(space: gymnasium.Space, value: object, place: str, findings: Findings, path: str = "observation") -> list[Leaf]:
    """The leaves of an observation; those of spaces no learner knows are left out.

    Raises CannotGoOn, with the finding added, if the keys, the number of parts, a type or a shape differ from the space's.
    """
    match space:
        case spaces.Dict():
            if not isinstance(value, Mapping) or set(value) != set(space.keys()):
                came = f"has the keys {_names(value)}" if isinstance(value, Mapping) else f"is a {type(value).__name__}"
                _refuse(findings, "structure", f"{place}: {path} {came}, but its space is a Dict of {_names(space.spaces)}")
            assert isinstance(value, Mapping)
            return [leaf for key, part in space.items() for leaf in read_leaves(part, value[key], place, findings, f"{path}[{key!r}]")]
        case spaces.Tuple():
            if not isinstance(value, tuple | list) or len(value) != len(space):
                came = f"has {len(value)} parts" if isinstance(value, tuple | list) else f"is a {type(value).__name__}"
                _refuse(findings, "structure", f"{place}: {path} {came}, but its space is a Tuple of {len(space)}")
            assert isinstance(value, tuple | list)
            return [leaf for i, part in enumerate(space) for leaf in read_leaves(part, value[i], place, findings, f"{path}[{i}]")]
        case _ if not isinstance(space, PLAIN_SPACES):
            return []
    return [Leaf(path, space, value, _as_array(space, value, f"{place}: {path}", findings))]


def key_of(leaves: list[Leaf]) -> Key:
    """An observation in a form to compare."""
    return tuple(leaf_key(leaf.array) for leaf in leaves)


def leaf_key(array: np.ndarray) -> bytes:
    """An array in a form to compare."""
    return array.tobytes() if array.nbytes <= WHOLE_BYTES else hashlib.blake2b(array.tobytes(), digest_size=16).digest()


def key_of_values(leaves: list[Leaf]) -> Key:
    """What these leaves hold now: the environment may have written to them since."""
    return tuple(leaf_key(np.asarray(leaf.value)) for leaf in leaves)


def check_leaves(leaves: list[Leaf], place: str, findings: Findings, *, loose_bounds: bool) -> None:
    """Types, finite numbers and bounds; `loose_bounds`: floats are known to leave theirs, and training does not mind."""
    for leaf in leaves:
        _check_type(leaf, place, findings)
        if leaf.array.dtype.kind == "f" and not np.isfinite(leaf.array).all():
            where, value = _first(leaf, ~np.isfinite(leaf.array))
            findings.error(
                "observation_not_finite",
                f"{place}: {where} is {value}",
                "find the division by zero, root or overflow that makes it; end the episode before the simulation diverges",
                leaf.path,
            )
        else:
            _check_bounds(leaf, place, findings, loose_bounds and leaf.array.dtype.kind == "f")


def _as_array(space: gymnasium.Space, value: object, where: str, findings: Findings) -> np.ndarray:
    try:
        array = np.asarray(value)
    except (ValueError, TypeError) as error:
        _refuse(findings, "type", f"{where} is a {type(value).__name__} that is no array of numbers ({error})")
    if array.dtype.kind not in "biuf":
        _refuse(findings, "type", f"{where} is a {type(value).__name__} (dtype {array.dtype}), but its space is {space}")
    if array.shape != space.shape:
        _refuse(findings, "shape", f"{where} has the shape {array.shape}, but its space says {space.shape}")
    return array


def _check_type(leaf: Leaf, place: str, findings: Findings) -> None:
    came, told = leaf.array.dtype, np.dtype(leaf.space.dtype or np.int64)
    seen = array_dtype(leaf.space.dtype)
    if not np.can_cast(came, seen, "same_kind"):
        findings.error(
            "observation_dtype",
            f"{place}: {leaf.path} is {came}, but its space says {told}: what learns sees {seen}, which cannot hold it",
            f"return np.{told}, or change the dtype of the space",
            leaf.path,
        )
    elif not isinstance(leaf.space, spaces.Discrete) and not isinstance(leaf.value, np.ndarray | np.generic):
        report = findings.hint if hasattr(leaf.value, "__array__") else findings.warning
        report(
            "observation_type",
            f"{place}: {leaf.path} is a {type(leaf.value).__name__}, not a NumPy array",
            f"return np.array(..., dtype=np.{told})",
            leaf.path,
        )
    elif told.kind == "f" and not np.can_cast(came, told, "safe"):
        findings.warning(
            "observation_dtype",
            f"{place}: {leaf.path} is {came}, but its space says {told}: training allows it, Gymnasium's own check of the space does not",
            f"return it as .astype(np.{told})",
            leaf.path,
        )


def _check_bounds(leaf: Leaf, place: str, findings: Findings, known: bool) -> None:
    low, high = limits(leaf.space)
    # Exactly, as training does: a float32 bound is a little less or more than what was written.
    outside = (leaf.array < low) | (leaf.array > high)
    if not outside.any():
        return
    where, value = _first(leaf, outside)
    index = np.unravel_index(int(np.argmax(outside)), outside.shape)
    report = findings.hint if known else findings.error
    report(
        "observation_bounds",
        f"{place}: {where} is {value:.9g}, but its space says {float(low[index]):.9g} to {float(high[index]):.9g}",
        "nothing: it is known of this environment, and training allows for it"
        if known
        else "widen the space to what can happen, or clip the observation (np.clip) to the space",
        leaf.path,
    )


def limits(space: gymnasium.Space) -> tuple[np.ndarray, np.ndarray]:
    """The least and the largest value of each element of a plain space."""
    match space:
        case spaces.Box():
            return space.low, space.high
        case spaces.Discrete():
            return np.asarray(space.start), np.asarray(space.start + space.n - 1)
        case spaces.MultiDiscrete():
            return space.start, space.start + space.nvec - 1
    return np.zeros(space.shape or ()), np.ones(space.shape or ())


def _first(leaf: Leaf, wrong: np.ndarray) -> tuple[str, float]:
    """The path and value of the first element that is wrong."""
    index = np.unravel_index(int(np.argmax(wrong)), wrong.shape)
    path = leaf.path + (f"[{', '.join(map(str, map(int, index)))}]" if index else "")
    return path, float(leaf.array[index])


def _refuse(findings: Findings, kind: str, message: str) -> NoReturn:
    fixes = {
        "structure": "return exactly the parts that observation_space names, or change the space",
        "type": "return numbers: np.array(..., dtype=observation_space.dtype), of the shape of the space",
        "shape": "make observation_space and the returned array agree, from reset and from step",
    }
    findings.error(f"observation_{kind}", message, fixes[kind])
    raise CannotGoOn


def _names(keys: Mapping) -> list[str]:
    return sorted(map(str, keys))
