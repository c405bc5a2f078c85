"""Between one environment's observations and actions and the batched NumPy arrays a learner sees.

Kept free of JAX, so that worker processes start fast. Observations: floats become float32, whole numbers int32, uint8 stays, Dict and Tuple
spaces become a dict or tuple of arrays. Actions: a Discrete action counts from 0 (the engine adds the space's ``start``), a Box action is
clipped to the space's bounds by the engine.
"""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import gymnasium
import numpy as np
from gymnasium import spaces

from thorndike.errors import UserError

if TYPE_CHECKING:
    # An array, or a dict or tuple of them; jaxtyping would bring JAX.
    from jaxtyping import PyTree

PLAIN_SPACES = (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)


def check_spaces(observation: gymnasium.Space, action: gymnasium.Space, name: str) -> None:
    """Raises UserError in one line if a learner cannot be shown these spaces."""
    for leaf in _leaves(observation):
        if not isinstance(leaf, PLAIN_SPACES):
            raise UserError(
                f"observation space of {name} must be made of Box, Discrete, MultiDiscrete, MultiBinary, Dict or Tuple, not "
                f"{type(leaf).__name__}: turn it into one of them with a gymnasium wrapper"
            )
    if not isinstance(action, PLAIN_SPACES):
        raise UserError(
            f"action space of {name} must be Discrete, MultiDiscrete, MultiBinary or Box, not {type(action).__name__}: "
            "flatten it with a gymnasium wrapper"
        )


def array_dtype(dtype: np.dtype | type | None) -> np.dtype:
    """The dtype a learner sees for a space's dtype: float32, int32 or uint8."""
    kind = np.dtype(dtype or np.float32)
    if kind == np.uint8:
        return kind
    return np.dtype(np.float32 if kind.kind == "f" else np.int32)


def allocator(space: gymnasium.Space, count: int) -> "Callable[[], PyTree]":
    """A function that makes unwritten arrays for ``count`` observations of ``space``; what can be looked up once is."""
    match space:
        case spaces.Dict():
            parts = {key: allocator(part, count) for key, part in space.items()}
            return lambda: {key: part() for key, part in parts.items()}
        case spaces.Tuple():
            members = [allocator(part, count) for part in space]
            return lambda: tuple(part() for part in members)
    shape, dtype = (count, *(space.shape or ())), array_dtype(space.dtype)
    return lambda: np.empty(shape, dtype)


def fresh_copy(space: gymnasium.Space, batch: "PyTree") -> "PyTree":
    """A batched observation of any dtype as new arrays of the dtypes a learner sees."""
    match space:
        case spaces.Dict():
            return {key: fresh_copy(part, batch[key]) for key, part in space.items()}
        case spaces.Tuple():
            return tuple(fresh_copy(part, value) for part, value in zip(space, batch, strict=True))
    return np.array(batch, array_dtype(space.dtype))


def with_rows(arrays: "PyTree", rows: np.ndarray, values: "PyTree") -> "PyTree":
    """A copy of ``arrays`` in which ``rows`` (numbers or a mask) are ``values``."""
    match arrays:
        case dict():
            return {key: with_rows(part, rows, values[key]) for key, part in arrays.items()}
        case tuple():
            return tuple(with_rows(part, rows, value) for part, value in zip(arrays, values, strict=True))
    changed = arrays.copy()
    changed[rows] = values
    return changed


def take(arrays: "PyTree", rows: np.ndarray) -> "PyTree":
    """The chosen rows, as new arrays."""
    match arrays:
        case dict():
            return {key: take(part, rows) for key, part in arrays.items()}
        case tuple():
            return tuple(take(part, rows) for part in arrays)
    return arrays[rows]


def duplicate(arrays: "PyTree") -> "PyTree":
    """New arrays with the same contents."""
    match arrays:
        case dict():
            return {key: duplicate(part) for key, part in arrays.items()}
        case tuple():
            return tuple(duplicate(part) for part in arrays)
    return arrays.copy()


def action_converter(space: gymnasium.Space) -> Callable[[np.ndarray], np.ndarray]:
    """A function from a learner's batch of actions to a batch the environment accepts."""
    match space:
        case spaces.Box():
            low, high, dtype = space.low, space.high, space.dtype
            return lambda actions: np.minimum(np.maximum(actions, low), high).astype(dtype, copy=False)
        case spaces.Discrete() | spaces.MultiDiscrete() if np.any(space.start):
            start, whole = space.start, space.dtype
            return lambda actions: np.asarray(actions).astype(whole) + start
    kind = np.dtype(space.dtype or np.int64)
    return lambda actions: np.asarray(actions).astype(kind)


def check_seeds(seeds: Sequence[int], num_envs: int) -> list[int]:
    """The seeds as plain ints. Raises ValueError unless there is one for each environment."""
    if len(seeds) != num_envs:
        raise ValueError(f"reset needs one seed for each of the {num_envs} environments, not {len(seeds)}")
    return [int(seed) for seed in seeds]


def _leaves(space: gymnasium.Space) -> list[gymnasium.Space]:
    match space:
        case spaces.Dict():
            return [leaf for part in space.values() for leaf in _leaves(part)]
        case spaces.Tuple():
            return [leaf for part in space for leaf in _leaves(part)]
    return [space]
