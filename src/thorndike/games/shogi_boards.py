"""Boards of shogi and of animal shogi (dobutsu shogi: three by four). Moves are called as USI engines call them: ``7g7f+``, ``P*5e``.

The first and the last row of a board are what the players hold in hand: the upper one the second player's, the lower one the first's.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from thorndike.games.face import Face
from thorndike.games.game import Board, Position, Square

_RANKS = "abcdefghi"


class _Kind(NamedTuple):
    """pgx numbers squares file by file from the right, from the far rank, as the mover sees them."""

    files: int
    ranks: int
    pieces: Sequence[str]
    """The mover's, by pgx's numbers; the other's follow."""
    squares: Callable[[Position], np.ndarray]
    hands: Callable[[Position], np.ndarray]
    """The mover's, the other's."""
    decode: Callable[[Position, int], "_Move"]


class _Move(NamedTuple):
    """As the mover sees it."""

    start: int
    """A square; of a drop, the number of the piece."""
    end: int
    is_drop: bool = False
    promotes: bool = False


def _shogi_like(kind: _Kind) -> Face:
    last = kind.files * kind.ranks - 1

    def seen(position: Position, square: int) -> int:
        """As the first player sees it."""
        return square if int(position.current_player) == 0 else last - square

    def on_board(position: Position, square: int) -> Square:
        file, rank = divmod(seen(position, square), kind.ranks)
        return rank + 1, kind.files - 1 - file

    def name_of(position: Position, square: int) -> str:
        file, rank = divmod(seen(position, square), kind.ranks)
        return f"{file + 1}{_RANKS[rank]}"

    def action_name(position: Position, action: int) -> str:
        move = kind.decode(position, action)
        start = f"{kind.pieces[move.start]}*" if move.is_drop else name_of(position, move.start)
        return start + name_of(position, move.end) + ("+" if move.promotes else "")

    def board(position: Position, legal: Sequence[int]) -> Board:
        second = int(position.current_player)
        rows = [[""] * kind.files for _ in range(kind.ranks + 2)]
        for square, piece in enumerate(kind.squares(position)):
            if piece >= 0:
                whose, number = divmod(int(piece), len(kind.pieces))
                row, column = on_board(position, square)
                rows[row][column] = _cased(kind.pieces[number], whose ^ second)
        for whose, hand in enumerate(kind.hands(position)):
            for number, count in enumerate(hand):
                if count:
                    piece = _cased(kind.pieces[number], whose ^ second)
                    rows[0 if whose ^ second else -1][number] = piece + (str(count) if count > 1 else "")
        clicks: dict[tuple[Square, ...], int] = {}
        buttons = {}
        for action in sorted(legal, key=lambda action: not kind.decode(position, action).promotes):
            move = kind.decode(position, action)
            start = (0 if second else kind.ranks + 1, move.start) if move.is_drop else on_board(position, move.start)
            click = (start, on_board(position, move.end))
            # Two clicks promote where that is possible: not to is a button.
            if click in clicks:
                buttons[action_name(position, action)] = action
            else:
                clicks[click] = action
        files = tuple(str(kind.files - i) for i in range(kind.files))
        return Board(tuple(map(tuple, rows)), ("hand", *_RANKS[: kind.ranks], "hand"), files, clicks, buttons)

    return Face(board, action_name)


def _cased(piece: str, player: int) -> str:
    return piece.lower() if player else piece


def _shogi() -> Face:
    from pgx._src.games.shogi import LEGAL_FROM_IDX

    origins = np.asarray(LEGAL_FROM_IDX)

    def decode(position: Position, action: int) -> _Move:
        direction, end = divmod(action, 81)
        if direction >= 20:
            return _Move(direction - 20, end, is_drop=True)
        squares = np.asarray(position._x.board)
        # The one piece of the mover's that stands on the way to there: the others' numbers begin at 14.
        start = next(int(i) for i in origins[direction % 10, end] if i >= 0 and squares[i] >= 0 and squares[i] < 14)
        return _Move(start, end, promotes=direction >= 10)

    pieces = ("P", "L", "N", "S", "B", "R", "G", "K", "+P", "+L", "+N", "+S", "+B", "+R")
    return _shogi_like(_Kind(9, 9, pieces, lambda p: np.asarray(p._x.board), lambda p: np.asarray(p._x.hand), decode))


def _animal_shogi() -> Face:
    """The pieces are chick, elephant, giraffe, lion and hen, by Fairy-Stockfish's letters."""
    steps = ((-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1))

    def decode(position: Position, action: int) -> _Move:
        direction, square = divmod(action, 12)
        if direction >= 8:
            return _Move(direction - 8, square, is_drop=True)
        file, rank = steps[direction]
        # A chick that reaches the last rank always becomes a hen.
        promotes = square % 4 == 1 and int(position._board[square]) == 0
        return _Move(square, square + 4 * file + rank, promotes=promotes)

    return _shogi_like(_Kind(3, 4, "CEGLH", lambda p: np.asarray(p._board), lambda p: np.asarray(p._hand), decode))


def __getattr__(name: str) -> Face:
    """Made when it is asked for: shogi's tables in pgx take seconds to build."""
    makers = {"SHOGI": _shogi, "ANIMAL_SHOGI": _animal_shogi}
    if name not in makers:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return makers[name]()
