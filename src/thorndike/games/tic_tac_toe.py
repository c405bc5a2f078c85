"""Tic-tac-toe (noughts and crosses): three in a row on a board of three by three.

The nine squares of each player are bits of one word, which a search copies at every node: bit ``3 * row + column``, from the top left.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, UInt32

from thorndike.games.game import Board, Game, Position, Square, Symmetry

_LINES = np.array([0b111, 0b111000, 0b111000000, 0b1001001, 0b10010010, 0b100100100, 0b100010001, 0b1010100], np.uint32)
_SQUARES = np.arange(9, dtype=np.uint32)
_NAMES = tuple(f"{column}{row}" for row in "321" for column in "abc")


class TicTacToePosition(NamedTuple):
    """Where each player's pieces are."""

    pieces: UInt32[Array, " 2"]


def _init(key: Key[Array, ""]) -> TicTacToePosition:
    return TicTacToePosition(jnp.zeros((2,), jnp.uint32))


def _player(position: TicTacToePosition) -> Int[Array, ""]:
    return jnp.sum(_bits(position.pieces[0] | position.pieces[1])) % 2


def _step(position: TicTacToePosition, action: Int[Array, ""], key: Key[Array, ""]) -> TicTacToePosition:
    placed = jnp.uint32(1) << action.astype(jnp.uint32)
    mover = jnp.arange(2) == _player(position)
    return TicTacToePosition(jnp.where(mover, position.pieces | placed, position.pieces))


def _legal(position: TicTacToePosition) -> Bool[Array, " 9"]:
    return _bits(position.pieces[0] | position.pieces[1]) == 0


def _terminated(position: TicTacToePosition) -> Bool[Array, ""]:
    return jnp.any(_won(position)) | (position.pieces[0] | position.pieces[1] == 0b111111111)


def _rewards(position: TicTacToePosition) -> Float[Array, " 2"]:
    won = _won(position).astype(jnp.float32)
    return won - won[::-1]


def _observe(position: TicTacToePosition) -> Float[Array, "3 3 2"]:
    """The mover's pieces, the other's."""
    first = _player(position) == 0
    mine, theirs = (jnp.where(first, position.pieces[i], position.pieces[1 - i]) for i in (0, 1))
    return jnp.stack([_bits(mine), _bits(theirs)], axis=-1).astype(jnp.float32).reshape(3, 3, 2)


def _bits(word: UInt32[Array, ""]) -> Int[Array, " 9"]:
    return (word >> _SQUARES & jnp.uint32(1)).astype(jnp.int32)


def _won(position: TicTacToePosition) -> Bool[Array, " 2"]:
    return jnp.any(position.pieces[:, None] & _LINES[None] == _LINES[None], axis=1)


def _board(position: TicTacToePosition) -> Board:
    pieces = np.asarray(position.pieces)
    marks = ["X" if pieces[0] >> i & 1 else "O" if pieces[1] >> i & 1 else "" for i in range(9)]
    over = bool(_terminated(position))
    clicks: dict[tuple[Square, ...], int] = {((i // 3, i % 3),): i for i in range(9) if marks[i] == "" and not over}
    return Board(tuple(tuple(marks[i : i + 3]) for i in (0, 3, 6)), ("3", "2", "1"), ("a", "b", "c"), clicks, {})


def _action_name(position: Position, action: int) -> str:
    """Column and row, as ``b2`` for the middle."""
    return _NAMES[action]


def _symmetry(turns: int, mirrored: bool) -> Symmetry:
    def turned(squares: Float[Array, "3 3 channels"]) -> Float[Array, "3 3 channels"]:
        return jnp.rot90(squares[:, ::-1] if mirrored else squares, turns)

    numbers = np.arange(9).reshape(3, 3)
    return Symmetry(turned, np.rot90(numbers[:, ::-1] if mirrored else numbers, turns).reshape(9))


TIC_TAC_TOE = Game(
    id="tic_tac_toe",
    num_actions=9,
    observation_shape=(3, 3, 2),
    max_moves=9,
    init=_init,
    step=_step,
    legal=_legal,
    player=_player,
    terminated=_terminated,
    rewards=_rewards,
    observe=_observe,
    board=_board,
    action_name=_action_name,
    symmetries=tuple(_symmetry(turns, mirrored) for mirrored in (False, True) for turns in range(4))[1:],
)
