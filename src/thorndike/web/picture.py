"""What there is to see of a table, in words and numbers: everything that the page then only has to draw."""

from collections.abc import Mapping
from typing import NamedTuple

from thorndike.games.game import Choice, Game, Square
from thorndike.games.plies import Ply, line_names, target_square
from thorndike.games.squares import square_name
from thorndike.games.table import View
from thorndike.web.looks import Look, look_of

_LONGEST_LINE = 8
"""Moves of the expected line that are named."""


class Picture(NamedTuple):
    """All texts and numbers of the page."""

    status: str
    hint: str
    """A second line below: what can be done now."""
    board: Mapping[str, object]
    """The properties of ``board.js``."""
    probabilities: tuple[float | None, ...]
    """By position: how likely the first player wins."""
    analysis: str
    """What the search says about the position looked at."""
    chance: str
    """The latest of them up to the position looked at, in words."""
    over: bool


def picture(game: Game, view: View) -> Picture:
    """Draw one moment."""
    look, ply = look_of(game.id), view.ply
    choice = view.choices.get(view.shown)
    shares = _shares(game, ply, choice, view.pending) if choice is not None and view.analyse else {}
    last, probabilities = _last_square(game, view), _probabilities(view)
    return Picture(
        status=_status(look, view),
        hint=_hint(view),
        board={
            "pieces": look.pieces,
            "rows": ply.board.rows,
            "rowNames": ply.board.row_names,
            "columnNames": ply.board.column_names,
            "labels": _labels(look, view, shares, last),
            "last": last,
            "line": _winning_line(look, ply.board.rows) if view.outcome is not None and view.at_end else (),
            "pending": view.pending,
            "shares": [[*square, share] for square, share in shares.items()],
            "playable": _is_persons_turn(view),
            "arrows": not ply.board.clicks and any(name in ply.board.buttons for name in ("left", "right", "up", "down")),
            "side": ply.player,
        },
        probabilities=probabilities,
        chance=_chance(look, probabilities[: view.shown + 1]),
        analysis=_analysis(game, look, view, choice),
        over=view.outcome is not None,
    )


def _is_persons_turn(view: View) -> bool:
    return view.outcome is None and view.at_end and view.seats[view.ply.player].player is None


def _status(look: Look, view: View) -> str:
    persons = [number for number, seat in enumerate(view.seats) if seat.player is None]
    if view.outcome is not None and view.at_end:
        return _result(look, view, persons)
    if not view.at_end:
        return f"Position after move {view.shown} of {len(view.moves)}" if view.shown else f"The beginning, of {len(view.moves)} moves"
    if len(view.seats) == 1:
        return f"Your move. Score {sum(ply.rewards[0] for ply in view.plies):g}"
    seat, side = view.seats[view.ply.player], look.sides[view.ply.player]
    if view.thinking is not None:
        return f"{view.thinking} is thinking"
    if view.paused and seat.player is not None:
        return f"{seat.name} ({side}) waits"
    return f"Your turn: you are {side}" if len(persons) == 1 else f"{side} to move"


def _result(look: Look, view: View, persons: list[int]) -> str:
    outcome = view.outcome
    assert outcome is not None
    if len(view.seats) == 1:
        return f"The game is over. Score {sum(ply.rewards[0] for ply in view.plies):g}"
    if outcome.winner is None:
        return "A draw"
    winner = look.sides[outcome.winner]
    how = f", {look.sides[1 - outcome.winner]} resigned" if outcome.resigned else ""
    if len(persons) == 1:
        return f"You win{how}" if outcome.winner == persons[0] else f"{view.seats[outcome.winner].name} wins{how}"
    return f"{winner} wins{how}"


def _hint(view: View) -> str:
    if view.notice:
        return view.notice
    if view.thinking is not None:
        return "Stop it whenever you like"
    if view.paused and view.outcome is None:
        return "Let it go on, take a move back, or swap sides"
    if not view.at_end:
        return "Step through it, or play on from here"
    return "" if view.outcome is None else "Step back through it, or begin a new game"


def _last_square(game: Game, view: View) -> Square | None:
    return target_square(game, view.plies[view.shown - 1], view.moves[view.shown - 1]) if view.shown else None


def _winning_line(look: Look, rows: tuple[tuple[str, ...], ...]) -> tuple[Square, ...]:
    """The squares of a row of equal pieces that is long enough, if that is how this game is won."""
    for row in range(len(rows)):
        for column in range(len(rows[row])):
            for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
                squares = [(row + step * down, column + step * right) for step in range(look.line)]
                pieces = {rows[r][c] for r, c in squares if r < len(rows) and 0 <= c < len(rows[r])}
                inside = all(r < len(rows) and 0 <= c < len(rows[r]) for r, c in squares)
                if squares and inside and len(pieces) == 1 and "" not in pieces:
                    return tuple(squares)
    return ()


def _shares(game: Game, ply: Ply, choice: Choice, pending: tuple[Square, ...]) -> dict[Square, float]:
    """The share of a search's visits by square: where a piece is put, or which piece is moved first."""
    total = sum(choice.visits.values()) if choice.visits else 0
    shares: dict[Square, float] = {}
    for action, visits in (choice.visits or {}).items():
        square = _square(game, ply, action, pending)
        if square is not None and visits > 0:
            shares[square] = shares.get(square, 0.0) + visits / total
    return shares


def _square(game: Game, ply: Ply, action: int, pending: tuple[Square, ...]) -> Square | None:
    clicks = [squares for squares, of in ply.board.clicks.items() if of == action]
    if len(clicks) != 1 or len(clicks[0]) == 1:
        return target_square(game, ply, action) if clicks else None
    if clicks[0][: len(pending)] != pending:
        return None
    return clicks[0][min(len(pending), len(clicks[0]) - 1)]


def _labels(look: Look, view: View, shares: Mapping[Square, float], last: Square | None) -> list[list[str]]:
    board = view.ply.board
    words = {"X": look.sides[0], "O": look.sides[1], "": "empty"}

    def label(square: Square) -> str:
        piece = board.rows[square[0]][square[1]]
        parts = [square_name(board, square), words.get(piece, _piece_name(look, piece))]
        parts += ["last move"] if square == last else []
        parts += ["chosen"] if square in view.pending else []
        parts += [f"{shares[square]:.0%} of the search"] if square in shares else []
        return ", ".join(parts)

    return [[label((row, column)) for column in range(len(squares))] for row, squares in enumerate(board.rows)]


_CHESS = {"k": "king", "q": "queen", "r": "rook", "b": "bishop", "n": "knight", "p": "pawn"}


def _piece_name(look: Look, piece: str) -> str:
    if look.pieces != "chess" or piece.lower() not in _CHESS:
        return piece
    return f"{'White' if piece.isupper() else 'Black'} {_CHESS[piece.lower()]}"


def _probabilities(view: View) -> tuple[float | None, ...]:
    if len(view.seats) != 2:
        return ()
    told: list[float | None] = []
    for number, ply in enumerate(view.plies):
        chance = view.choices[number].win_probability if number in view.choices else None
        told.append(chance if chance is None or ply.player == 0 else 1 - chance)
    if view.outcome is not None:
        told[-1] = {None: 0.5, 0: 1.0, 1: 0.0}[view.outcome.winner]
    return tuple(told)


def _chance(look: Look, told: tuple[float | None, ...]) -> str:
    known = [chance for chance in told if chance is not None]
    return f"{look.sides[0]} {known[-1]:.0%}" if known else ""


def _analysis(game: Game, look: Look, view: View, choice: Choice | None) -> str:
    if not view.analyse:
        return ""
    if choice is None:
        return "Searching…" if view.analysing else "Nothing was searched here"
    ply, parts = view.ply, list[str]()
    if choice.win_probability is not None:
        parts.append(f"{look.sides[ply.player]} wins with {choice.win_probability:.0%}")
    if choice.visits:
        parts.append(f"{sum(choice.visits.values()):,} visits, their shares on the board")
    line = line_names(game, ply, choice.principal_variation, _LONGEST_LINE)
    if line:
        parts.append(f"expected: {' '.join(line)}")
    return " · ".join(parts) or "The player does not tell what it thought"
