"""Engines that speak UCI, or USI, its twin for shogi: Stockfish, Fairy-Stockfish and others.

python-chess speaks UCI too, but only of games that it knows the rules of, which Gardner's chess and animal shogi are not; here the rules
are the game's own, and one client serves all.
"""

import math
import time
from collections.abc import Mapping

from thorndike.games.engine_player import Answered, Dialogue, Start, started
from thorndike.games.engine_process import EngineProcess
from thorndike.games.game import Turn
from thorndike.games.plies import MoveNames

_PATIENCE_S = 10.0
"""For everything but a move."""
_PAWNS_TO_ODDS = 400.0
"""Centipawns that mean ten to one."""


def uci_start(
    command: tuple[str, ...], options: Mapping[str, str], limit: Mapping[str, int], move_limit_s: float, protocol: str = "uci"
) -> Start:
    """How to start an engine. ``limit`` is what ``go`` is told (``movetime``, ...); it is given up on after ``move_limit_s`` seconds."""
    go = " ".join(["go", *(f"{name} {value}" for name, value in limit.items())])

    def start() -> Dialogue:
        names = MoveNames()

        def prepare(process: EngineProcess) -> None:
            process.send(protocol)
            wait_for(process, f"{protocol}ok")
            for name, value in options.items():
                process.send(f"setoption name {name} value {value}")
            ready(process)
            process.send(f"{protocol}newgame")
            ready(process)

        process = started(command, prepare)

        def ask(turn: Turn) -> Answered:
            process.stopped = turn.stopped
            played = " ".join(name for _, name in names(turn))
            process.send(f"position startpos{' moves ' if played else ''}{played}")
            process.send(go)
            until, win_probability = time.monotonic() + move_limit_s, None
            while (words := process.line(until).split())[:1] != ["bestmove"]:
                win_probability = told_probability(words, win_probability)
            return Answered(words[1] if len(words) > 1 else "nothing", win_probability)

        return Dialogue(ask, process.close)

    return start


def ready(process: EngineProcess) -> None:
    """Wait until the engine has done what it was told."""
    process.send("isready")
    wait_for(process, "readyok")


def wait_for(process: EngineProcess, word: str) -> None:
    """Read on to this line. Raises ``EngineFailure`` if it does not come."""
    until = time.monotonic() + _PATIENCE_S
    while process.line(until).strip() != word:
        continue


def told_probability(words: list[str], before: float | None) -> float | None:
    """The mover's probability of winning by a line of an engine's thoughts, or what was known before."""
    if words[:1] != ["info"] or "score" not in words:
        return before
    kind, value = [*words[words.index("score") + 1 :], "", ""][:2]
    try:
        number = int(value)
    except ValueError:
        return before
    if kind == "mate":
        return 1.0 if number > 0 else 0.0
    return 1.0 / (1.0 + math.pow(10.0, -max(min(number, 4000), -4000) / _PAWNS_TO_ODDS)) if kind == "cp" else before
