"""How each game looks, and what its sides are called. A game that is not named here is drawn with letters."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple


class Look(NamedTuple):
    """What the rules do not say."""

    title: str
    pieces: str
    """How ``board.js`` draws: ``marks``, ``discs``, ``stones``, ``go``, ``hex``, ``chess`` or ``letters``."""
    sides: tuple[str, str]
    """Of the player who moves first, and of the other."""
    rule: str
    """In one line, what it is about."""
    line: int = 0
    """How many in a row win, where that is how one wins."""


LOOKS: Mapping[str, Look] = MappingProxyType(
    {
        "tic_tac_toe": Look("Tic-tac-toe", "marks", ("X", "O"), "Three in a row, on nine squares.", line=3),
        "connect_four": Look("Connect Four", "discs", ("Red", "Yellow"), "Pieces fall; four in a row win.", line=4),
        "othello": Look("Othello", "stones", ("Black", "White"), "Enclose the other's stones to turn them; most stones win."),
        "hex": Look("Hex", "hex", ("Red", "Blue"), "Join your two sides of the board."),
        "go_9x9": Look("Go 9x9", "go", ("Black", "White"), "Enclose more of the small board."),
        "go_19x19": Look("Go 19x19", "go", ("Black", "White"), "Enclose more of the board."),
        "chess": Look("Chess", "chess", ("White", "Black"), "Checkmate the king."),
        "gardner_chess": Look("Gardner chess", "chess", ("White", "Black"), "Chess on five by five."),
        "animal_shogi": Look("Animal shogi", "letters", ("First", "Second"), "Catch the lion, on twelve squares."),
        "shogi": Look("Shogi", "letters", ("Black", "White"), "Japanese chess: what is taken comes back."),
        "backgammon": Look("Backgammon", "letters", ("First", "Second"), "Race by the dice."),
        "2048": Look("2048", "letters", ("You", "Nobody"), "Slide equal tiles together."),
    }
)


def look_of(game_id: str) -> Look:
    """The look of a game, one of letters if it is not known."""
    known = LOOKS.get(game_id)
    return known or Look(game_id.rpartition(":")[2].replace("_", " ").capitalize(), "letters", ("First", "Second"), "A game of your own.")
