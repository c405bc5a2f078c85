"""Action masks: where they are found, and whether they fit the action space."""

from collections.abc import Mapping
from typing import TypeAlias

import gymnasium
import numpy as np
from gymnasium import spaces

from thorndike.environments.checking.findings import Findings

Mask: TypeAlias = np.ndarray | tuple[np.ndarray, ...]
"""What ``space.sample(mask=...)`` takes: int8, one array for Discrete and MultiBinary, a tuple of them for MultiDiscrete."""

KIND = "action_mask"


def find_masks(environment: gymnasium.Env, observation: object, info: Mapping[str, object]) -> dict[str, object]:
    """The masks there are, by where they are: ``info``, ``observation``, ``action_masks()``."""
    found: dict[str, object] = {}
    if "action_mask" in info:
        found["info['action_mask']"] = info["action_mask"]
    if isinstance(observation, Mapping) and "action_mask" in observation:
        found["observation['action_mask']"] = observation["action_mask"]
    method = environment.get_wrapper_attr("action_masks") if environment.has_wrapper_attr("action_masks") else None
    if callable(method):
        found["action_masks()"] = method()
    return found


def check_masks(space: gymnasium.Space, masks: Mapping[str, object], place: str, findings: Findings) -> Mask | None:
    """The mask to act by, None if there is none that fits."""
    fitting = {
        source: mask for source, value in masks.items() if (mask := _check(space, value, f"{place}: {source}", findings)) is not None
    }
    first = next(iter(fitting.items()), None)
    if first is None:
        return None
    for source, mask in fitting.items():
        if not np.array_equal(mask, first[1]):
            findings.error(KIND, f"{place}: {source} differs from {first[0]}", "give one mask, or the same in each place", "differ")
    return None if first[1].all() else _for_sampling(space, first[1])


def _check(space: gymnasium.Space, value: object, where: str, findings: Findings) -> np.ndarray | None:
    """The mask as one row of int8, or None, with the finding added, if it does not fit."""
    parts = _sizes(space)
    if parts is None:
        findings.warning(
            KIND,
            f"{where} masks a {type(space).__name__} action space",
            "masks are for Discrete, MultiDiscrete and MultiBinary: leave it out",
            "kind",
        )
        return None
    row = np.concatenate([np.ravel(part) for part in value]) if isinstance(value, tuple | list) and len(parts) > 1 else np.asarray(value)
    if row.shape != (sum(parts),):
        _refuse(
            findings,
            f"{where} has the shape {row.shape}, but {space} needs ({sum(parts)},)",
            f"return bool or int8 of shape ({sum(parts)},)",
        )
        return None
    if row.dtype.kind not in "biu" or not np.isin(row, (0, 1)).all():
        _refuse(
            findings, f"{where} holds {row.dtype} {np.unique(row)[:4].tolist()}", "use bool, or int8 with 1 for what is allowed and 0 else"
        )
        return None
    blocked = [number for number, part in enumerate(_split(row, parts)) if not part.any()]
    if blocked:
        what = "no action" if len(parts) == 1 else f"nothing in dimensions {blocked}"
        _refuse(findings, f"{where} allows {what}", "allow at least one action in every state that is not an end, or end the episode there")
        return None
    return row.astype(np.int8)


def _refuse(findings: Findings, message: str, fix: str) -> None:
    findings.error(KIND, message, fix, fix)


def _sizes(space: gymnasium.Space) -> list[int] | None:
    """The number of choices in each dimension; None for a space that masks are not made for."""
    match space:
        case spaces.Discrete():
            return [int(space.n)]
        case spaces.MultiDiscrete():
            return np.ravel(space.nvec).tolist()
        case spaces.MultiBinary():
            return [2] * int(np.prod(space.shape))
    return None


def _split(row: np.ndarray, parts: list[int]) -> list[np.ndarray]:
    return np.split(row, np.cumsum(parts)[:-1])


def _for_sampling(space: gymnasium.Space, row: np.ndarray) -> Mask:
    match space:
        case spaces.MultiDiscrete():
            return tuple(_split(row, np.ravel(space.nvec).tolist()))
        case spaces.MultiBinary():
            # Gymnasium's own form: 0 and 1 are what it must be, 2 is free.
            zero, one = row.reshape(-1, 2).T
            return np.where(zero & one, 2, one).astype(np.int8).reshape(space.shape)
    return row
