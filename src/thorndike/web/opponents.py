"""Whom one can play against, by game."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple, TypeAlias

from thorndike.errors import UserError
from thorndike.games.engines import ENGINES, program_of
from thorndike.games.game import Game, Player
from thorndike.games.registry import FOR_ONE, can_be_searched
from thorndike.games.registry import game as find_game
from thorndike.games.trained import trained_run
from thorndike.training.run_listing import all_runs, read_facts
from thorndike.user_code import lasting_name

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
"""A game's id -> who plays it, besides another person. The game is not made for it: that can take seconds."""

ANOTHER_PERSON = Opponent(PERSON, "Another person, here", None)
ALONE = Opponent(PERSON, "Nobody: one plays alone", None)
_LONG = ("chess", "shogi", "go_19x19")
"""Games that take a search minutes to play out at random as often as it must."""
_ENGINE_NAMES = {"gnugo": "GNU Go", "gnubg": "GNU Backgammon", "rhino": "grhino", "stockfish": "Stockfish", "fairy": "Fairy-Stockfish"}


def is_for_one(game_id: str) -> bool:
    """Whether one plays this game alone."""
    return find_game(game_id).num_players == 1 if ":" in game_id else game_id in FOR_ONE


def opponents_in(output: Path) -> Opponents:
    """What was trained in a folder of runs, a plain search, programs that are installed, random moves."""

    def opponents(game_id: str) -> Sequence[Opponent]:
        if is_for_one(game_id):
            return ()
        searched = can_be_searched(game_id)
        found = [
            _named(str(run), f"{run.parent.name}, {run.name}", searched, before="Trained: ")
            for run in reversed(all_runs(output))
            if _trained_on(run, game_id)
        ]
        if (shipped := trained_run(game_id)) is not None:
            found.append(_named(str(shipped), "Thorndike's own", searched, before="Trained: "))
        if searched and game_id not in _LONG:
            found.append(_named("mcts", "Tree search", searches=True, after=", without a network"))
        found += [_named(name, _ENGINE_NAMES.get(name, name)) for name in ENGINES if _plays(name, game_id)]
        return [*found, _named("random", "Random moves")]

    return opponents


def _named(who: str, name: str, searches: bool = False, before: str = "", after: str = "") -> Opponent:
    """``name`` is what it is called at the table; ``before`` and ``after`` are added where one chooses."""

    def make(game: Game, simulations: int) -> Player:
        from thorndike.api.playing import player

        return player(who, game, simulations=simulations)._replace(name=name)

    return Opponent(who, before + name + after, make, searches)


def _trained_on(run: Path, game_id: str) -> bool:
    """Whether a run has a policy for this game. One whose files are damaged has not."""
    try:
        return read_facts(run).get("environment") == lasting_name(game_id) and (run / "policy").is_dir()
    except (UserError, OSError):
        return False


def _plays(name: str, game_id: str) -> bool:
    try:
        return game_id in ENGINES[name].games and bool(program_of(ENGINES[name]))
    except UserError:
        return False
