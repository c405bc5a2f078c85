"""How a game of pgx looks to people: its board, and what its actions are called."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from jaxtyping import Array, Float

from thorndike.games.game import Board, Position, Symmetry


class Face(NamedTuple):
    """What pgx leaves out: everything but the rules."""

    board: Callable[[Position, Sequence[int]], Board]
    """Position and its legal actions -> the board."""
    action_name: Callable[[Position, int], str]
    symmetries: tuple[Symmetry, ...] = ()
    observe: Callable[[Position], Float[Array, "height width channels"]] | None = None
    """What the player to move sees, where pgx's own form is hard to learn from."""
    ownership: Callable[[Position], Float[Array, "height width"]] | None = None
    """Whose the squares are, where that decides the game."""
    komi: float = 0.0
