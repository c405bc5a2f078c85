"""One name, one game: our own, those of pgx, and a user's by ``module:attribute`` or ``path/to/file.py:attribute``.

Nothing heavy is imported before a game is made: a wrong name is answered at once.
"""

import importlib
from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING

from thorndike.errors import UserError
from thorndike.suggestions import did_you_mean
from thorndike.user_code import attribute_in_file, import_module, load_file

if TYPE_CHECKING:
    from thorndike.games.game import Game

OWN_GAMES: Mapping[str, str] = MappingProxyType(
    {
        "tic_tac_toe": "thorndike.games.tic_tac_toe:TIC_TAC_TOE",
        "connect_four": "thorndike.games.connect_four:CONNECT_FOUR",
    }
)
"""Id -> ``module:attribute`` of the game."""
ADAPTED_GAMES: Mapping[str, str] = MappingProxyType(
    dict.fromkeys(
        ("othello", "hex", "go_9x9", "go_19x19", "chess", "gardner_chess", "shogi", "animal_shogi", "backgammon", "2048"),
        "thorndike.games.pgx_games:pgx_game",
    )
)
"""Id -> ``module:function`` that makes the game of this id."""
_FORMS = "path/to/file.py:NAME"


def game_ids() -> tuple[str, ...]:
    """Every game that has an id, our own first."""
    return (*OWN_GAMES, *ADAPTED_GAMES)


def game(name: str) -> "Game":
    """The game of an id, ``module:attribute`` or ``path/to/file.py:attribute`` (a ``Game``, or a function that makes one).

    Raises UserError in one line for a name that is not known, with the nearest known one.
    """
    if name in OWN_GAMES:
        module, attribute = OWN_GAMES[name].split(":")
        return getattr(importlib.import_module(module), attribute)
    if name in ADAPTED_GAMES:
        module, attribute = ADAPTED_GAMES[name].split(":")
        return getattr(importlib.import_module(module), attribute)(name)
    if ":" not in name:
        raise UserError(f"unknown game {name!r}{did_you_mean(name, game_ids())}")
    return _of_the_user(name)


def _of_the_user(name: str) -> "Game":
    from thorndike.games.game import Game

    in_file = attribute_in_file(name)
    module_name, _, attribute = name.rpartition(":")
    module = import_module(module_name, name, _FORMS) if in_file is None else load_file(in_file[0], "the game")
    found = getattr(module, attribute, None)
    if found is None:
        games = [key for key, value in vars(module).items() if isinstance(value, Game)]
        raise UserError(f"{name}: no game {attribute!r} there{did_you_mean(attribute, games)}")
    made = found if isinstance(found, Game) or not callable(found) else found()
    if not isinstance(made, Game):
        raise UserError(f"{name} must be a thorndike.games.game.Game, or a function that makes one, not {type(made).__name__}")
    return made
