"""What players are called on a command line, checked before anything heavy is imported."""

import os
from collections.abc import Iterable

from thorndike.errors import UserError
from thorndike.games.engines import ENGINES, PROTOCOLS, check_engine, is_engine, read_settings
from thorndike.games.trained import trained_run
from thorndike.suggestions import nearest

RANDOM, MCTS, TRAINED = "random", "mcts", "trained"
_OF_MCTS = {"simulations": (1, 1_000_000)}


def known_players() -> tuple[str, ...]:
    """By their short names."""
    return (RANDOM, MCTS, TRAINED, *ENGINES)


def is_run(text: str) -> bool:
    """Whether a player's name is none of the short ones."""
    return not (text in (RANDOM, TRAINED) or text.partition(":")[0] == MCTS or is_engine(text))


def split_checkpoint(text: str) -> tuple[str, str | None]:
    """Of ``RUN@STEP`` the run and the step; of a run's name, or a directory that is there, None for the step."""
    run, at, step = text.rpartition("@")
    return (text, None) if not at or "/" in step or os.path.exists(text) else (run, step)


def check_player(text: str, game: str, can_be_searched: bool) -> None:
    """Raises UserError for a short name that cannot play. Whether a run is there is for others to say."""
    if is_engine(text):
        check_engine(text, game)
    elif text == TRAINED and trained_run(game) is None:
        raise UserError(f"no trained policy comes with {game}; train one, or play against mcts")
    elif text.partition(":")[0] == MCTS:
        mcts_simulations(text, 1)
        if not can_be_searched:
            raise UserError(f"mcts plays games of two players without dice, which {game} is not; here play random and trained runs")


def mcts_simulations(text: str, default: int) -> int:
    """Of ``mcts[:simulations=N]``. Raises UserError for other settings."""
    return read_settings(MCTS, text.partition(":")[2], _OF_MCTS).get("simulations", default)


def suggestion(text: str, runs: Iterable[str] = ()) -> str | None:
    """The nearest short name or protocol to one that is no run either."""
    return nearest(text.partition(":")[0], [*known_players(), *PROTOCOLS, *runs])
