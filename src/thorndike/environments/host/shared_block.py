"""The memory that a pool's processes share: every worker writes its own row of it, the parent reads all rows.

Anonymous memory without a name in the file system: nothing of it is left when its processes are gone, however they went.
"""

import mmap
import os
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import gymnasium
import numpy as np
from gymnasium import spaces

from thorndike.environments.host.arrays import array_dtype

if TYPE_CHECKING:
    # An array, or a dict or tuple of them; jaxtyping would bring JAX.
    from jaxtyping import PyTree

_ALIGNMENT = 64
_Place = Callable[[tuple[int, ...], np.dtype], np.ndarray]


class Block(NamedTuple):
    """One step of ``B`` environments, all arrays ``[B, ...]``."""

    next_obs: "PyTree"
    obs: "PyTree"
    """After a reset; of rows that were not reset, from before."""
    action: np.ndarray
    reward: np.ndarray
    cost: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    resetting: np.ndarray
    """Whether a worker is at the reset that follows an end: a hang is named by where it is."""


class _Layout:
    """Gives out one array after another of a buffer or, without one, only adds up how long it must be."""

    def __init__(self, buffer: mmap.mmap | None = None) -> None:
        self.length, self._buffer = 0, buffer

    def place(self, shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
        begin, size = self.length, int(np.prod(shape))
        self.length += -(-size * dtype.itemsize // _ALIGNMENT) * _ALIGNMENT
        if self._buffer is None:
            return np.empty(0, dtype)
        return np.frombuffer(self._buffer, dtype, size, begin).reshape(shape)


def create_block(observation: gymnasium.Space, action: gymnasium.Space, count: int) -> tuple[int, Block]:
    """A new block for `count` environments of these spaces, and the file descriptor by which workers open it."""
    layout = _Layout()
    _arrays(observation, action, count, layout.place)
    file = os.memfd_create("thorndike-environments", os.MFD_CLOEXEC)
    os.ftruncate(file, layout.length)
    return file, open_block(file, observation, action, count)


def open_block(file: int, observation: gymnasium.Space, action: gymnasium.Space, count: int) -> Block:
    """The block behind a file descriptor."""
    return _arrays(observation, action, count, _Layout(mmap.mmap(file, 0)).place)


def row_of(block: Block, row: int) -> Block:
    """The same memory, of one row only: arrays ``[1, ...]``."""
    return Block(*(_rows(field, slice(row, row + 1)) for field in block))


def _arrays(observation: gymnasium.Space, action: gymnasium.Space, count: int, place: _Place) -> Block:
    numbers, flags = np.dtype(np.float32), np.dtype(np.bool_)
    return Block(
        _observations(observation, count, place),
        _observations(observation, count, place),
        place((count, *(action.shape or ())), np.dtype(action.dtype or np.int64)),
        *(place((count,), dtype) for dtype in (numbers, numbers, flags, flags, flags)),
    )


def _observations(space: gymnasium.Space, count: int, place: _Place) -> "PyTree":
    match space:
        case spaces.Dict():
            return {key: _observations(part, count, place) for key, part in space.items()}
        case spaces.Tuple():
            return tuple(_observations(part, count, place) for part in space)
    return place((count, *(space.shape or ())), array_dtype(space.dtype))


def _rows(arrays: "PyTree", rows: slice) -> "PyTree":
    match arrays:
        case dict():
            return {key: _rows(part, rows) for key, part in arrays.items()}
        case tuple():
            return tuple(_rows(part, rows) for part in arrays)
    return arrays[rows]
