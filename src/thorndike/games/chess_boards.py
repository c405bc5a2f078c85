"""Boards of chess: eight by eight, and Gardner's five by five. Moves are called as UCI engines call them: ``e2e4``, ``e7e8n``."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thorndike.games.face import Face
from thorndike.games.game import Board, Position, Square

_PIECES = " PNBRQK"
_UNDERPROMOTIONS = "rbn"
_FILES = "abcdefgh"


def _chess(size: int) -> Face:
    """pgx numbers squares file by file from the mover's side; an action is a square and one of so many planes."""
    destinations = _destinations(size)
    planes = destinations.shape[1]

    def square(index: int, black: bool) -> Square:
        file, rank = divmod(index, size)
        return (rank if black else size - 1 - rank), file

    def ends(position: Position, action: int) -> tuple[Square, Square]:
        black = int(position.current_player) == 1
        start, plane = divmod(action, planes)
        return square(start, black), square(int(destinations[start, plane]), black)

    def name_of(square: Square) -> str:
        return f"{_FILES[square[1]]}{size - square[0]}"

    def promotion(position: Position, action: int) -> str:
        start, plane = divmod(action, planes)
        if plane < 9:
            return _UNDERPROMOTIONS[plane // 3]
        return "q" if _pieces(position)[start] == 1 and start % size == size - 2 else ""

    def action_name(position: Position, action: int) -> str:
        return "".join(map(name_of, ends(position, action))) + promotion(position, action)

    def board(position: Position, legal: Sequence[int]) -> Board:
        black = int(position.current_player) == 1
        rows = [[""] * size for _ in range(size)]
        for index, piece in enumerate(_pieces(position)):
            row, column = square(index, black)
            letter = _PIECES[abs(piece)].strip()
            rows[row][column] = letter if (piece > 0) != black else letter.lower()
        clicks: dict[tuple[Square, ...], int] = {}
        buttons = {}
        for action in legal:
            if promotion(position, action) in ("", "q"):
                clicks[ends(position, action)] = action
            else:
                buttons[action_name(position, action)] = action
        ranks = tuple(str(size - i) for i in range(size))
        return Board(tuple(map(tuple, rows)), ranks, tuple(_FILES[:size]), clicks, buttons)

    return Face(board, action_name, observe=_seen_by_mover)


def _seen_by_mover(position: Position) -> Float[Array, "files ranks channels"]:
    """The mover's six kinds of pieces, the other's, ones, moves without progress, whether the position was there before; in chess also
    castling rights and the square to capture on in passing.

    Squares lie as pgx numbers its actions, so that a square's moves stand where the square does. pgx itself shows eight positions in over a
    hundred planes, and counts how often each was there.
    """
    is_chess = hasattr(position, "_x")
    inside = position._x if is_chess else position
    board, told = (inside.board, inside.hash_history) if is_chess else (inside._board, inside._hash_history)
    idle = inside.halfmove_count if is_chess else inside._halfmove_count
    squares = board.shape[0]
    size = int(np.sqrt(squares))
    kinds = np.arange(1, 7)
    pieces = board[:, None] == np.concatenate([kinds, -kinds])[None, :]
    again = jnp.sum(jnp.all(told == told[:1], axis=1)) > 1
    whole = [jnp.ones(()), idle.astype(jnp.float32) / 100.0, again.astype(jnp.float32)]
    whole += list(inside.castling_rights.reshape(-1).astype(jnp.float32)) if is_chess else []
    planes = [pieces.astype(jnp.float32), jnp.broadcast_to(jnp.stack(whole)[None, :], (squares, len(whole)))]
    planes += [(jnp.arange(squares) == inside.en_passant).astype(jnp.float32)[:, None]] if is_chess else []
    return jnp.concatenate(planes, axis=1).reshape(size, size, -1)


def _pieces(position: Position) -> np.ndarray:
    """By square as the mover sees it; below 0 the other's."""
    return np.asarray(position._x.board if hasattr(position, "_x") else position._board)


def _destinations(size: int) -> np.ndarray:
    """``[squares, planes]``: where a move ends, -1 beyond the board."""
    if size == 8:
        from pgx._src.games.chess import FROM_PLANE

        return np.asarray(FROM_PLANE)
    from pgx._src.gardner_chess_utils import TO_MAP

    return np.asarray(TO_MAP)


def __getattr__(name: str) -> Face:
    """Made when it is asked for: each kind of chess has tables in pgx that take seconds to build."""
    sizes = {"CHESS": 8, "GARDNER_CHESS": 5}
    if name not in sizes:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return _chess(sizes[name])
