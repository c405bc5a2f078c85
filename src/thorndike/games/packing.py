"""A position as one row of whole numbers, in which it travels through observations, replay and files, and back."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int32

from thorndike.games.game import Game, Position


class Packing(NamedTuple):
    """There and back."""

    size: int
    """Numbers of a position."""
    pack: Callable[[Position], Int32[Array, " size"]]
    unpack: Callable[[Int32[Array, " size"]], Position]


def packing(game: Game) -> Packing:
    """How positions of a game are packed: arrays of 32 bits as they are, bit by bit, smaller ones a number an entry."""
    leaves, structure = jax.tree.flatten(jax.eval_shape(game.init, jax.random.key(0)))
    plain = [jax.eval_shape(_plain, leaf) for leaf in leaves]
    ends = [sum(leaf.size for leaf in plain[: i + 1]) for i in range(len(plain))]

    def pack(position: Position) -> Int32[Array, " size"]:
        return jnp.concatenate([_as_numbers(_plain(leaf)).reshape(-1) for leaf in jax.tree.leaves(position)])

    def unpack(numbers: Int32[Array, " size"]) -> Position:
        parts = jnp.split(numbers, ends[:-1])
        return jax.tree.unflatten(structure, [_from_numbers(*each) for each in zip(parts, plain, leaves, strict=True)])

    return Packing(ends[-1], pack, unpack)


def _plain(leaf: Array) -> Array:
    """The bits of a key, any other array as it is."""
    return jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf


def _as_numbers(leaf: Array) -> Int32[Array, "..."]:
    return jax.lax.bitcast_convert_type(leaf, jnp.int32) if leaf.dtype.itemsize == 4 else leaf.astype(jnp.int32)


def _from_numbers(numbers: Int32[Array, " n"], plain: jax.ShapeDtypeStruct, leaf: jax.ShapeDtypeStruct) -> Array:
    shaped = numbers.reshape(plain.shape)
    values = jax.lax.bitcast_convert_type(shaped, plain.dtype) if plain.dtype.itemsize == 4 else shaped.astype(plain.dtype)
    is_key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    return jax.random.wrap_key_data(values) if is_key else values
