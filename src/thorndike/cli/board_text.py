"""A board as text."""

from thorndike.games.game import Board


def board_text(board: Board) -> str:
    """Rows under each other with their names to the left, the columns' names below, then the caption."""
    cells = [[piece or "." for piece in row] for row in board.rows]
    width = max(len(text) for text in (*board.column_names, *(cell for row in cells for cell in row)))
    margin = max(map(len, board.row_names))
    lines = [f"{name:>{margin}}  " + " ".join(f"{cell:>{width}}" for cell in row) for name, row in zip(board.row_names, cells, strict=True)]
    if any(board.column_names):
        lines.append(" " * (margin + 2) + " ".join(f"{name:>{width}}" for name in board.column_names))
    return "\n".join([*lines, *([board.caption] if board.caption else [])])
