"""Boards on which pieces are placed and stay: Hex and Go."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from thorndike.games.face import Face
from thorndike.games.game import Board, Position, Square
from thorndike.games.go_view import seen_by_mover
from thorndike.games.turning import turned_board

_LETTERS = "abcdefghijklmnopqrstuvwxyz"
_GO_LETTERS = "ABCDEFGHJKLMNOPQRSTUVWXYZ"
"""Go players leave the I out."""
_KOMI = 7.5
"""pgx's."""
Turns = tuple[tuple[int, bool], ...]
"""Quarter turns, and whether the board is mirrored first."""
_ALL: Turns = tuple((turns, mirrored) for mirrored in (False, True) for turns in range(4))[1:]
# Anything but half a turn would exchange the sides that the players connect.
_HEX: Turns = ((2, False),)


def _placing(size: int, kind: str, extra: str, turns: Turns) -> Face:
    """A face of ``size`` x ``size`` squares; action ``size * size`` is called ``extra``."""
    letters = _GO_LETTERS if kind == "go" else _LETTERS
    row_names = [str(size - i if kind == "go" else i + 1) for i in range(size)]
    names = (*(f"{letters[column]}{row}" for row in row_names for column in range(size)), extra)

    def board(position: Position, legal: Sequence[int]) -> Board:
        stones = _stones(position, kind).reshape(size, size)
        rows = tuple(tuple("X" if stone > 0 else "O" if stone < 0 else "" for stone in row) for row in stones)
        clicks: dict[tuple[Square, ...], int] = {(divmod(action, size),): action for action in legal if action < size * size}
        buttons = {extra: size * size} if size * size in legal else {}
        return Board(rows, tuple(row_names), tuple(letters[:size]), clicks, buttons)

    def action_name(position: Position, action: int) -> str:
        return names[action]

    return Face(board, action_name, tuple(turned_board(size, *turn) for turn in turns))


def _go(size: int) -> Face:
    def ownership(position: Position) -> Float[Array, "height width"]:
        return area(position._x.board.reshape(size, size))

    return _placing(size, "go", "pass", _ALL)._replace(observe=seen_by_mover, ownership=ownership, komi=_KOMI)


def area(stones: Int[Array, "height width"]) -> Float[Array, "height width"]:
    """By Go's area scoring: 1 at black's stones (above 0) and where only black is reached through empty points, -1 so for white, else 0.

    Dead stones stay, as in pgx: who wants them off the board has to take them.
    """
    empty, colours = stones == 0, jnp.stack([stones > 0, stones < 0])

    def grow(carry: tuple[Bool[Array, "2 height width"], Bool[Array, ""]]) -> tuple[Bool[Array, "2 height width"], Bool[Array, ""]]:
        reached = jnp.pad(carry[0], ((0, 0), (1, 1), (1, 1)))
        beside = reached[:, 2:, 1:-1] | reached[:, :-2, 1:-1] | reached[:, 1:-1, 2:] | reached[:, 1:-1, :-2]
        after = carry[0] | (beside & empty[None])
        return after, jnp.any(after != carry[0])

    black, white = jax.lax.while_loop(lambda carry: carry[1], grow, (colours, jnp.array(True)))[0].astype(jnp.float32)
    return black - white


def _stones(position: Position, kind: str) -> np.ndarray:
    """Above 0 where player 0 is, below where player 1 is."""
    stones = np.asarray(position._x.board)
    # Go keeps black's view, Hex the mover's.
    return stones if kind == "go" or int(position.current_player) == 0 else -stones


HEX = _placing(11, "hex", "swap", _HEX)
GO_9X9 = _go(9)
GO_19X19 = _go(19)
