"""Finite observations as one whole number: the row of a table."""

import math
from collections.abc import Callable
from typing import NamedTuple

import gymnasium
import jax.numpy as jnp
import numpy as np
from gymnasium.spaces import Discrete, MultiDiscrete, Tuple
from jaxtyping import Array, Int, PyTree

from thorndike.errors import UserError


class StateIndex(NamedTuple):
    """How many states a finite space has, and which number an observation of it gets."""

    states: int
    number: Callable[[PyTree], Int[Array, "*batch"]]
    """Observation ``[*batch, ...]`` -> state number in ``[0, count)``."""


def state_index(space: gymnasium.Space) -> StateIndex:
    """Number the elements of a Discrete, MultiDiscrete or Tuple-of-Discrete space; the last component varies fastest.

    Raises UserError for any other space.
    """
    match space:
        case Discrete():
            start = int(space.start)
            return StateIndex(int(space.n), lambda obs: obs.astype(jnp.int32) - start)
        case MultiDiscrete():
            sizes, starts = np.ravel(space.nvec), np.ravel(space.start)
            depth = space.nvec.ndim
            return StateIndex(math.prod(sizes.tolist()), lambda obs: _mixed_radix(_columns(obs, depth), sizes, starts))
        case Tuple(spaces=spaces) if all(isinstance(part, Discrete) for part in spaces):
            parts = [part for part in spaces if isinstance(part, Discrete)]
            sizes, starts = np.array([part.n for part in parts]), np.array([part.start for part in parts])
            return StateIndex(math.prod(sizes.tolist()), lambda obs: _mixed_radix(list(obs), sizes, starts))
    raise UserError(
        f"a table needs Discrete, MultiDiscrete or Tuple-of-Discrete observations, not {space}: the discretise wrapper makes bins"
    )


def _columns(obs: Int[Array, "*shape"], depth: int) -> list[Int[Array, "*batch"]]:
    flat = obs.reshape(*obs.shape[: obs.ndim - depth], -1)
    return [flat[..., i] for i in range(flat.shape[-1])]


def _mixed_radix(columns: list[Int[Array, "*batch"]], sizes: np.ndarray, starts: np.ndarray) -> Int[Array, "*batch"]:
    number = jnp.zeros_like(columns[0], dtype=jnp.int32)
    for column, size, start in zip(columns, sizes.tolist(), starts.tolist(), strict=True):
        number = number * size + (column.astype(jnp.int32) - start)
    return number
