"""Whom one can play against, by game."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple, TypeAlias

from thorndike.games.game import Game, Player

PERSON = "person"
STRENGTHS = (16, 64, 200, 800, 3200)
"""Simulations a move that can be chosen."""
STRENGTH = 200
"""The one that is chosen at first."""


class Opponent(NamedTuple):
    """Somebody who can sit down at a table."""

    id: str
    name: str
    make: Callable[[Game, int], Player] | None
    """Game, simulations a move -> the player. None: a person at the page."""
    searches: bool = False
    """Whether the number of simulations means anything, and the positions of a person can be searched too."""


Opponents: TypeAlias = Callable[[str], Sequence[Opponent]]
"""A game's id -> who plays it."""

ANOTHER_PERSON = Opponent(PERSON, "Another person, here", None)


def opponents_in(output: Path) -> Opponents:
    """Those that are always there, and what was trained in a folder of runs."""

    def opponents(game_id: str) -> Sequence[Opponent]:
        return ()

    return opponents
