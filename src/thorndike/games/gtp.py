"""Engines that speak the Go Text Protocol, version 2 (Farnebäck 2002): GNU Go, and GRhino for Othello."""

import time

from thorndike.games.engine_player import Answered, Dialogue, Start, started
from thorndike.games.engine_process import EngineFailure, EngineProcess
from thorndike.games.game import Turn
from thorndike.games.plies import MoveNames

_COLOURS = ("black", "white")
_PATIENCE_S = 10.0
"""For everything but a move."""


def gtp_start(
    command: tuple[str, ...],
    size: int,
    komi: float | None,
    move_limit_s: float,
    passes_are_told: bool = True,
    generate: str = "genmove",
) -> Start:
    """How to start an engine on boards of ``size``; it is given up on if a move takes longer than ``move_limit_s``.

    ``generate`` is what it is asked for a move with.
    """

    def start() -> Dialogue:
        names = MoveNames()
        known: list[int] = []
        """The actions that the engine has played on its board."""

        def begin(process: EngineProcess) -> None:
            told(process, f"boardsize {size}")
            told(process, "clear_board")
            if komi is not None:
                told(process, f"komi {komi}")

        process = started(command, begin)

        def catch_up(turn: Turn) -> None:
            if list(turn.moves[: len(known)]) != known:
                begin(process)
                known.clear()
            for player, name in names(turn)[len(known) :]:
                if passes_are_told or name != "pass":
                    told(process, f"play {_COLOURS[player]} {name}")
            known[:] = turn.moves

        def ask(turn: Turn) -> Answered:
            process.stopped = turn.stopped
            catch_up(turn)
            colour = _COLOURS[int(turn.game.player(turn.position))]
            # It plays its move on its board too, which we take back: the match decides what is played.
            move = told(process, f"{generate} {colour}", move_limit_s)
            if move.lower() != "resign":
                told(process, "undo")
            return Answered(move)

        return Dialogue(ask, process.close)

    return start


def told(process: EngineProcess, command: str, limit_s: float = _PATIENCE_S) -> str:
    """What the engine answers to a command. Raises ``EngineFailure`` if it refuses it, or does not answer."""
    until = time.monotonic() + limit_s
    process.send(command)
    first = ""
    while not first.startswith(("=", "?")):
        first = process.line(until)
    lines = [first[1:].strip()]
    while line := process.line(until):
        lines.append(line)
    if first.startswith("?"):
        raise EngineFailure(f"refused '{command}': {lines[0][:80]}")
    return "\n".join(lines)
