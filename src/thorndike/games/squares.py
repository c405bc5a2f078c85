"""Squares and the moves that clicks on them mean."""

from thorndike.games.game import Board, Square


def begins_a_move(board: Board, squares: tuple[Square, ...]) -> bool:
    """Whether a legal move begins with clicks on these squares."""
    return any(clicks[: len(squares)] == squares for clicks in board.clicks)


def why_not(board: Board, pending: tuple[Square, ...], square: Square) -> str:
    """Why a click means nothing, in words; ``pending``: the squares clicked before it."""
    row, column = square
    if not (0 <= row < len(board.rows) and 0 <= column < len(board.rows[row])):
        return f"there is no square {square}"
    name = square_name(board, square)
    if pending:
        return f"{square_name(board, pending[-1])} cannot go to {name}"
    if any(len(clicks) > 1 for clicks in board.clicks):
        return f"{name} is empty: choose a piece first" if not board.rows[row][column] else f"the piece on {name} cannot move now"
    return f"{name} is taken" if board.rows[row][column] else f"{name} is no legal move now"


def square_name(board: Board, square: Square) -> str:
    """Column and row, as ``b2``."""
    return f"{board.column_names[square[1]]}{board.row_names[square[0]]}"
