"""Boards on which pieces are placed and stay: Hex and Go."""

from collections.abc import Sequence

import numpy as np

from thorndike.games.face import Face
from thorndike.games.game import Board, Position, Square
from thorndike.games.go_view import seen_by_mover
from thorndike.games.turning import turned_board

_LETTERS = "abcdefghijklmnopqrstuvwxyz"
_GO_LETTERS = "ABCDEFGHJKLMNOPQRSTUVWXYZ"
"""Go players leave the I out."""
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


def _stones(position: Position, kind: str) -> np.ndarray:
    """Above 0 where player 0 is, below where player 1 is."""
    stones = np.asarray(position._x.board)
    # Go keeps black's view, Hex the mover's.
    return stones if kind == "go" or int(position.current_player) == 0 else -stones


HEX = _placing(11, "hex", "swap", _HEX)
GO_9X9 = _placing(9, "go", "pass", _ALL)._replace(observe=seen_by_mover)
GO_19X19 = _placing(19, "go", "pass", _ALL)._replace(observe=seen_by_mover)
