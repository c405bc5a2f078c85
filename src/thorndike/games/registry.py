"""One name, one game: our own, those of pgx, and a user's by ``module:attribute`` or ``path/to/file.py:attribute``.

Nothing heavy is imported before a game is made: a wrong name is answered at once.
"""

import importlib
import sys
from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, cast

from thorndike.errors import UserError
from thorndike.suggestions import did_you_mean
from thorndike.user_code import attribute_in_file, import_module, load_file

if TYPE_CHECKING:
    from thorndike.games.game import Game

OWN_GAMES: Mapping[str, str] = MappingProxyType(
    {
        "tic_tac_toe": "thorndike.games.tic_tac_toe:TIC_TAC_TOE",
        "connect_four": "thorndike.games.connect_four:CONNECT_FOUR",
        "othello": "thorndike.games.othello:OTHELLO",
    }
)
"""Id -> ``module:attribute`` of the game."""
ADAPTED_GAMES: Mapping[str, str] = MappingProxyType(
    dict.fromkeys(
        ("hex", "go_9x9", "go_19x19", "chess", "gardner_chess", "shogi", "animal_shogi", "backgammon", "2048"),
        "thorndike.games.pgx_games:pgx_game",
    )
)
"""Id -> ``module:function`` that makes the game of this id."""
FOR_ONE, WITH_DICE = ("2048",), ("backgammon",)
"""Ids of games that one plays alone, and of those of two that throw dice, which is known here because to make some games takes seconds."""
_FORMS = "path/to/file.py:NAME"


def game_ids() -> tuple[str, ...]:
    """Every game that has an id, our own first."""
    return (*OWN_GAMES, *ADAPTED_GAMES)


def can_be_searched(name: str) -> bool:
    """What its ``Game`` says of itself, before it is made: whether it is a game of two without dice."""
    return game(name).can_be_searched if ":" in name else name not in (*FOR_ONE, *WITH_DICE)


def is_game(name: str) -> bool:
    """Whether ``game(name)`` finds one. Code of the user's is imported for it, for nothing else tells."""
    if name in OWN_GAMES or name in ADAPTED_GAMES:
        return True
    return ":" in name and _is_instance(_named(name)[0])


def game(name: str) -> "Game":
    """The game of an id, or the ``Game`` that ``module:attribute`` or ``path/to/file.py:attribute`` names.

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
    found, others = _named(name)
    if found is None:
        raise UserError(f"{name}: there is no such game{did_you_mean(name.rpartition(':')[2], others)}")
    if not _is_instance(found):
        raise UserError(f"{name} must be a thorndike.games.game.Game, not {type(found).__name__}")
    return cast("Game", found)


def _named(name: str) -> tuple[object, list[str]]:
    """What ``module:attribute`` or ``path/to/file.py:attribute`` names, None if there is no such thing, and the games that are there."""
    in_file = attribute_in_file(name)
    module_name, _, attribute = name.rpartition(":")
    module = import_module(module_name, name, _FORMS) if in_file is None else load_file(in_file[0], "the game")
    return getattr(module, attribute, None), [key for key, value in vars(module).items() if _is_instance(value)]


def _is_instance(value: object) -> bool:
    """Whether it is a ``Game``. Who made one has imported what a game is, and JAX."""
    made = sys.modules.get("thorndike.games.game")
    return made is not None and isinstance(value, made.Game)
