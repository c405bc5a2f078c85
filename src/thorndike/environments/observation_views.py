"""How wrappers cut, stack and normalise observations, leaf by leaf, and what that makes of their spaces."""

from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeAlias

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from jaxtyping import Array, Bool, Float, Int32, Shaped

from thorndike.errors import UserError
from thorndike.functional.normalization import Moments, empty_moments
from thorndike.networks.masking import MASK
from thorndike.types import Observation

Bound: TypeAlias = float | Sequence[float | None] | None
"""One number for every dimension, one each (None: the space's own), or None: the space's own."""

LARGEST_FINITE = 1e30
"""Some spaces write the largest float32 where they mean infinity."""


class Grid(NamedTuple):
    """Equal bins over a box of D dimensions."""

    bins: Int32[np.ndarray, " D"]
    low: Float[np.ndarray, " D"]
    high: Float[np.ndarray, " D"]


def make_grid(space: gymnasium.Space, bins: int | Sequence[int], low: Bound, high: Bound) -> Grid:
    """The grid over a Box. Raises UserError for another space, bad bins, or bounds that are infinite, equal or crossed."""
    if not isinstance(space, spaces.Box):
        raise UserError(f"discretise needs a Box observation, not {space}: leave it out for whole numbers, or pick one part of a Dict")
    size = int(np.prod(space.shape))
    counts = np.broadcast_to(np.asarray(bins, np.int64), (size,)) if np.size(bins) in (1, size) else None
    if counts is None or np.any(counts < 1):
        raise UserError(f"discretise needs one number of bins, or one for each of the {size} dimensions, all at least 1, not {bins}")
    if np.prod(counts, dtype=np.float64) >= 2**31:
        raise UserError(f"discretise into {bins} bins makes {np.prod(counts, dtype=np.float64):.1e} states: give fewer bins a dimension")
    lows, highs = _bound("low", low, space.low, size), _bound("high", high, space.high, size)
    if np.any(lows >= highs):
        raise UserError(f"discretise needs low < high in every dimension, not low={lows.tolist()} and high={highs.tolist()}")
    return Grid(counts.astype(np.int32), lows, highs)


def bin_number(grid: Grid, obs: Float[Array, "batch *shape"]) -> Int32[Array, " batch"]:
    """The bin of each observation, the last dimension varying fastest."""
    flat = obs.reshape(obs.shape[0], -1)
    share = (flat - grid.low[None]) / (grid.high - grid.low)[None]
    index = jnp.clip(jnp.floor(share * grid.bins[None]).astype(jnp.int32), 0, grid.bins[None] - 1)
    number = jnp.zeros(obs.shape[0], jnp.int32)
    for dimension in range(flat.shape[1]):
        number = number * grid.bins[dimension] + index[:, dimension]
    return number


def map_space(function: Callable[[gymnasium.Space], gymnasium.Space], space: gymnasium.Space) -> gymnasium.Space:
    """`function` of every leaf of a space of Dict and Tuple."""
    match space:
        case spaces.Dict():
            return spaces.Dict({key: map_space(function, part) for key, part in space.items()})
        case spaces.Tuple():
            return spaces.Tuple([map_space(function, part) for part in space])
    return function(space)


def space_leaves(space: gymnasium.Space) -> list[gymnasium.Space]:
    """The leaves of a space in the order of ``jax.tree.leaves`` of its observations: the keys of a Dict sorted."""
    match space:
        case spaces.Dict():
            return [leaf for key in sorted(space.keys()) for leaf in space_leaves(space[key])]
        case spaces.Tuple():
            return [leaf for part in space for leaf in space_leaves(part)]
    return [space]


def is_float(space: gymnasium.Space) -> bool:
    """Whether observations of this leaf are floats."""
    return space.dtype is not None and space.dtype.kind == "f"


def clipped_box(space: gymnasium.Space, clip: float) -> gymnasium.Space:
    """What a float leaf becomes when it is normalised; another is as it was."""
    return spaces.Box(-clip, clip, space.shape, np.float32) if is_float(space) else space


def on_floats(function: Callable[[Array, Moments], Array], obs: Observation, moments: tuple[Moments | tuple[()], ...]) -> Observation:
    """`function` of each leaf that has moments, and the others as they are."""
    leaves, structure = jax.tree.flatten(obs)
    return jax.tree.unflatten(structure, [function(leaf, own) if own else leaf for leaf, own in zip(leaves, moments, strict=True)])


def fresh_moments(like: tuple[Moments | tuple[()], ...], batch: tuple[int, ...]) -> tuple[Moments | tuple[()], ...]:
    """Empty moments ``[*batch, *shape]`` for each of `like` ``[*shape]``."""
    return tuple(empty_moments(own.mean.shape, batch) if own else () for own in like)


def numbers_shape(leaf: gymnasium.Space) -> tuple[int, ...]:
    """The shape of a leaf's observations as ``as_numbers`` gives them: a Discrete one is a one-hot row."""
    return (int(leaf.n),) if isinstance(leaf, spaces.Discrete) else tuple(leaf.shape or ())


def shown_leaves(obs: Observation) -> list[Shaped[Array, "..."]]:
    """The leaves of an observation, without its action mask."""
    shown = {name: part for name, part in obs.items() if name != MASK} if isinstance(obs, dict) else obs
    return [jnp.asarray(leaf) for leaf in jax.tree.leaves(shown)]


def as_numbers(leaves: Sequence[Shaped[Array, "..."]], shapes: Sequence[tuple[int, ...]], leading: int) -> tuple[Float[Array, "..."], ...]:
    """Every leaf, behind so many leading axes, as floats of these shapes. Raises UserError where they are of another space."""
    found = [
        # A Discrete space may start at any number: the remainder numbers its elements all the same.
        jax.nn.one_hot(leaf % shape[0], shape[0]) if leaf.ndim == leading and len(shape) == 1 else leaf.astype(jnp.float32)
        for leaf, shape in zip(leaves, shapes, strict=False)
    ]
    seen = [row.shape[leading:] for row in found]
    if len(leaves) != len(shapes) or seen != list(shapes):
        raise UserError(f"observations of the shapes {list(shapes)} were expected, not {[leaf.shape[leading:] for leaf in leaves]}")
    return tuple(found)


def joined(rows: tuple[Float[Array, "N ..."], ...]) -> Float[Array, "N ..."]:
    """One picture as it is; anything else as one row of numbers."""
    if len(rows) == 1 and rows[0].ndim == 4:
        return rows[0]
    return jnp.concatenate([row.reshape(row.shape[0], -1) for row in rows], axis=-1)


def stacked_space(space: gymnasium.Space, k: int) -> gymnasium.Space:
    """A leaf `k` times on its last axis; a scalar gets one."""
    match space:
        case spaces.Box(shape=()):
            return spaces.Box(np.repeat(space.low, k), np.repeat(space.high, k), dtype=space.dtype.type)
        case spaces.Box():
            repeats = (1,) * (len(space.shape) - 1) + (k,)
            return spaces.Box(np.tile(space.low, repeats), np.tile(space.high, repeats), dtype=space.dtype.type)
        case spaces.Discrete():
            return spaces.MultiDiscrete([space.n] * k, start=[space.start] * k)
        case spaces.MultiDiscrete():
            repeats = (1,) * (space.nvec.ndim - 1) + (k,)
            return spaces.MultiDiscrete(np.tile(space.nvec, repeats), start=np.tile(space.start, repeats))
        case spaces.MultiBinary():
            return spaces.MultiBinary((*space.shape[:-1], k * space.shape[-1]))
    raise UserError(f"frame_stack cannot stack {space}: give it Box, Discrete, MultiDiscrete or MultiBinary observations")


def selected_space(space: gymnasium.Space, entries: Sequence[int]) -> gymnasium.Space:
    """The space of some entries of a vector. Raises UserError if it is none, or has them not."""
    if not isinstance(space, spaces.Box) or len(space.shape) != 1:
        raise UserError(f"select_observation takes entries of a Box vector, not of {space}")
    outside = [entry for entry in entries if not 0 <= entry < space.shape[0]]
    if outside or not entries:
        what = f"there is no entry {outside[0]}" if outside else "no entry was named"
        raise UserError(f"select_observation: {what}; the observation has the entries 0 to {space.shape[0] - 1}")
    chosen = np.asarray(entries)
    return spaces.Box(space.low[chosen], space.high[chosen], dtype=space.dtype.type)


def repeat_frame(leaf: Array, k: int) -> Array:
    """`k` copies of a frame ``[B, ...]`` on the last axis."""
    return jnp.concatenate([_with_axis(jnp.asarray(leaf))] * k, axis=-1)


def push_frame(stack: Array, leaf: Array) -> Array:
    """The oldest frame of a stack out, a new one in at the end."""
    frame = _with_axis(jnp.asarray(leaf))
    return jnp.concatenate([stack[..., frame.shape[-1] :], frame], axis=-1)


def choose_rows(condition: Bool[Array, " batch"], chosen: Array, otherwise: Array) -> Array:
    """Rows of ``[B, ...]`` by a condition ``[B]``."""
    return jnp.where(condition.reshape(-1, *(1,) * (chosen.ndim - 1)), chosen, otherwise)


def _with_axis(leaf: Array) -> Array:
    return leaf[:, None] if leaf.ndim == 1 else leaf


def _bound(side: str, given: Bound, own: np.ndarray, size: int) -> Float[np.ndarray, " D"]:
    values = list(given) if isinstance(given, Sequence | np.ndarray) else [given] * size
    if len(values) != size:
        raise UserError(f"discretise needs {size} values of {side}, one for each dimension, not {len(values)}")
    chosen = [float(fallback) if value is None else float(value) for value, fallback in zip(values, np.ravel(own), strict=True)]
    endless = [index for index, value in enumerate(chosen) if not abs(value) < LARGEST_FINITE]
    if endless:
        raise UserError(f"discretise needs a finite {side} for dimensions {endless}, which are endless in the space: give {side}=[...]")
    return np.asarray(chosen, np.float32)
