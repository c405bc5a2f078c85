"""The settings of a game as an environment, read before anything heavy is imported."""

from collections.abc import Mapping
from typing import NamedTuple

from thorndike.errors import UserError
from thorndike.games.registry import can_be_searched
from thorndike.suggestions import did_you_mean

OPPONENTS = ("random", "mcts")


class GameSettings(NamedTuple):
    """How self-play begins its games, and whom an agent is evaluated against."""

    opening_share: float = 0.7
    """Of the games of self-play, those that begin with random moves."""
    opening_plies: int | None = None
    """At most so many; None: a quarter of the longest game's."""
    opponent: str = "random"
    """``random``, or ``mcts``: plain Monte-Carlo tree search by random playouts."""
    opponent_simulations: int = 100
    """Playouts of ``mcts`` a move."""
    eval_opening_plies: int = 4
    """Games against the opponent begin with 0 to so many random moves, so that no two are alike."""


def game_settings(id: str, given: Mapping[str, object], max_episode_steps: int | None = None) -> GameSettings:
    """Settings from an environment's keyword arguments. Raises ``UserError`` for unknown ones, values that cannot be, and a time limit."""
    if max_episode_steps is not None:
        raise UserError(f"{id} is a game, which ends by its rules: leave max_episode_steps out")
    for name in given:
        if name not in GameSettings._fields:
            raise UserError(f"{id} has no setting {name!r}{did_you_mean(name, GameSettings._fields)}")
    values = {**GameSettings()._asdict(), **given}
    share, opponent = values["opening_share"], values["opponent"]
    plies, simulations, eval_plies = values["opening_plies"], values["opponent_simulations"], values["eval_opening_plies"]
    if not isinstance(share, int | float) or not 0 <= share <= 1:
        raise UserError(f"{id}: opening_share is a share of games, from 0 to 1, not {share!r}")
    if plies is not None and (not isinstance(plies, int) or plies < 0):
        raise UserError(f"{id}: opening_plies is a number of moves, 0 or more, not {plies!r}")
    if not isinstance(eval_plies, int) or eval_plies < 0:
        raise UserError(f"{id}: eval_opening_plies is a number of moves, 0 or more, not {eval_plies!r}")
    if not isinstance(opponent, str) or opponent not in OPPONENTS:
        raise UserError(f"{id}: unknown opponent {opponent!r}{did_you_mean(str(opponent), OPPONENTS)}")
    check_opponent(id, opponent, can_be_searched(id))
    if not isinstance(simulations, int) or simulations < 1:
        raise UserError(f"{id}: opponent_simulations is at least 1, not {simulations!r}")
    return GameSettings(share, plies, opponent, simulations, eval_plies)


def check_opponent(id: str, opponent: str, searched: bool) -> None:
    """Raises ``UserError`` for an opponent that searches a game with dice, or of one player."""
    if opponent == "mcts" and not searched:
        raise UserError(f"{id}: the opponent mcts plays games of two players without dice: leave opponent={opponent!r} out")
