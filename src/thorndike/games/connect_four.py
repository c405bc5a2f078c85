"""Connect Four: pieces fall down seven columns of six; four in a row, upright, level or slanting, win.

Each column is seven bits, the lowest row first and the seventh always empty, so that lines are found by shifts and no line runs round the
edge (after John Tromp's and Pascal Pons' boards). Seven columns are 49 bits: four columns in a low word and three in a high one.
"""

from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, UInt32

from thorndike.games.game import Board, Game, Position, Square, Symmetry

_ROWS, _COLUMNS = 6, 7
_LOW_BITS = 28
_LOW = np.uint32(2**_LOW_BITS - 1)
_WORD = np.array([0, 0, 0, 0, 1, 1, 1])
"""Which word a column is in, and where it begins there."""
_OFFSET = np.array([0, 7, 14, 21, 0, 7, 14], np.uint32)
_DIRECTIONS = (1, 7, 6, 8)
"""From a square to the one above it, beside it, below and beside it, above and beside it."""
_FROM_TOP = np.arange(_ROWS - 1, -1, -1, dtype=np.uint32)
_NAMES = "abcdefg"

Words: TypeAlias = UInt32[Array, " 2"]
"""Low word, high word."""


class ConnectFourPosition(NamedTuple):
    """Where each player's pieces are."""

    pieces: UInt32[Array, "2 2"]
    """By player, then low word and high word."""


def _init(key: Key[Array, ""]) -> ConnectFourPosition:
    return ConnectFourPosition(jnp.zeros((2, 2), jnp.uint32))


def _player(position: ConnectFourPosition) -> Int[Array, ""]:
    return (jnp.sum(jax.lax.population_count(position.pieces)) % 2).astype(jnp.int32)


def _step(position: ConnectFourPosition, action: Int[Array, ""], key: Key[Array, ""]) -> ConnectFourPosition:
    taken = position.pieces[0] | position.pieces[1]
    word, offset = jnp.where(action < 4, jnp.arange(2) == 0, jnp.arange(2) == 1), (action % 4 * 7).astype(jnp.uint32)
    # One more at the lowest square of the column carries to the lowest empty one.
    placed = jnp.where(word, (taken + (jnp.uint32(1) << offset)) & ~taken & (jnp.uint32(0b111111) << offset), jnp.uint32(0))
    mover = jnp.arange(2)[:, None] == _player(position)
    return ConnectFourPosition(jnp.where(mover, position.pieces | placed[None], position.pieces))


def _legal(position: ConnectFourPosition) -> Bool[Array, " 7"]:
    taken = position.pieces[0] | position.pieces[1]
    return taken[_WORD] >> (_OFFSET + np.uint32(_ROWS - 1)) & jnp.uint32(1) == 0


def _terminated(position: ConnectFourPosition) -> Bool[Array, ""]:
    return jnp.any(_won(position)) | ~jnp.any(_legal(position))


def _rewards(position: ConnectFourPosition) -> Float[Array, " 2"]:
    won = _won(position).astype(jnp.float32)
    return won - won[::-1]


def _observe(position: ConnectFourPosition) -> Float[Array, "6 7 2"]:
    """The mover's pieces, the other's; the top row first."""
    ordered = jnp.where(_player(position) == 0, position.pieces, position.pieces[::-1])
    columns = ordered[:, _WORD].T[None]
    return (columns >> (_OFFSET + _FROM_TOP[:, None])[..., None] & jnp.uint32(1)).astype(jnp.float32)


def _shifted(words: UInt32[Array, "players 2"], by: int) -> UInt32[Array, "players 2"]:
    """49 bits, by that many towards the lowest."""
    low, high = words[:, 0], words[:, 1]
    return jnp.stack([low >> np.uint32(by) | (high << np.uint32(_LOW_BITS - by)) & _LOW, high >> np.uint32(by)], axis=1)


def _won(position: ConnectFourPosition) -> Bool[Array, " 2"]:
    lines = jnp.zeros_like(position.pieces)
    for by in _DIRECTIONS:
        pairs = position.pieces & _shifted(position.pieces, by)
        lines |= pairs & _shifted(pairs, 2 * by)
    return jnp.any(lines != 0, axis=1)


def _board(position: ConnectFourPosition) -> Board:
    squares = np.asarray(_observe(position))
    pieces = ("X", "O") if int(_player(position)) == 0 else ("O", "X")
    rows = tuple(tuple(pieces[0] if mine else pieces[1] if theirs else "" for mine, theirs in row) for row in squares)
    open_columns = np.flatnonzero(np.asarray(_legal(position)) & ~np.asarray(_terminated(position)))
    clicks: dict[tuple[Square, ...], int] = {((row, int(column)),): int(column) for column in open_columns for row in range(_ROWS)}
    return Board(rows, tuple("654321"), tuple(_NAMES), clicks, {})


def _action_name(position: Position, action: int) -> str:
    """The column's letter."""
    return _NAMES[action]


CONNECT_FOUR = Game(
    id="connect_four",
    num_actions=_COLUMNS,
    observation_shape=(_ROWS, _COLUMNS, 2),
    max_moves=_ROWS * _COLUMNS,
    init=_init,
    step=_step,
    legal=_legal,
    player=_player,
    terminated=_terminated,
    rewards=_rewards,
    observe=_observe,
    board=_board,
    action_name=_action_name,
    symmetries=(Symmetry(lambda squares: squares[:, ::-1], np.arange(_COLUMNS)[::-1].copy()),),
)
