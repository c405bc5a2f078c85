"""How a game of pgx looks to people: its board, and what its actions are called."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from thorndike.games.game import Board, Position, Symmetry


class Face(NamedTuple):
    """What pgx leaves out: everything but the rules."""

    board: Callable[[Position, Sequence[int]], Board]
    """Position and its legal actions -> the board."""
    action_name: Callable[[Position, int], str]
    symmetries: tuple[Symmetry, ...] = ()
