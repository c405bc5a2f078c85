"""A program of somebody else's as a player: what it is asked, what becomes of its answers, and of its crashes.

A program that ends or hangs is started once more and told the moves so far; the second time it is given up. An answer that is no legal move
forfeits the game. One that is stopped is ended, for few programs listen while they think, and started again when it is next asked.
"""

import contextlib
from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import numpy as np

from thorndike.errors import UserError
from thorndike.games.engine_process import EngineFailure, EngineProcess
from thorndike.games.game import Choice, Player, Stopped, Turn, named_action


class Answered(NamedTuple):
    """What an engine says."""

    move: str
    """As it writes it; ``resign`` gives up."""
    win_probability: float | None = None


class Dialogue(NamedTuple):
    """One running program, spoken to in its protocol. Each function raises ``EngineFailure``."""

    ask: Callable[[Turn], Answered]
    """The move in this position, which may be of another game than the last one."""
    close: Callable[[], None]


Start: TypeAlias = Callable[[], Dialogue]
"""Start the program, and make it ready. Raises ``EngineFailure``, and ``UserError`` where it refuses its settings."""


def engine_player(name: str, start: Start, asked_always: bool = False) -> Player:
    """A player that asks the program that ``start`` starts; it runs from its first move on.

    With ``asked_always`` it is asked even where one move alone is legal: it plans several at once, and has to see the first.
    """
    running: list[Dialogue] = []

    def close() -> None:
        while running:
            running.pop().close()

    def answer(turn: Turn) -> Answered:
        if not running:
            running.append(start())
        try:
            return running[0].ask(turn)
        except Stopped:
            close()
            raise

    def choose(turn: Turn) -> Choice:
        legal = np.flatnonzero(np.asarray(turn.game.legal(turn.position)))
        if len(legal) == 1 and not asked_always:
            # Othello's engines pass without a word, and do not know how to be asked for it.
            return Choice(int(legal[0]))
        try:
            told = answer(turn)
        except EngineFailure:
            close()
            try:
                told = answer(turn)
            except EngineFailure as again:
                close()
                raise UserError(f"{name} {again}, and once more after a fresh start (move {len(turn.moves) + 1})") from again
        if told.move.lower() == "resign":
            return Choice(int(legal[0]), resigns=True, remark=f"{name} resigns")
        action = named_action(turn.game, turn.position, told.move)
        if action is None:
            # Fairy-Stockfish may leave a chick of animal shogi as it is on the last rank, where by these rules it becomes a hen.
            action = named_action(turn.game, turn.position, f"{told.move}+")
        if action is None:
            return Choice(int(legal[0]), resigns=True, remark=f"{name} forfeits: {told.move[:40]!r} is no legal move here")
        return Choice(action, told.win_probability)

    return Player(name, choose, close)


def started(command: tuple[str, ...], prepare: Callable[[EngineProcess], None]) -> EngineProcess:
    """A program that is ready; it is ended if it does not get that far."""
    process = EngineProcess(command)
    with contextlib.ExitStack() as undo:
        undo.callback(process.close)
        prepare(process)
        undo.pop_all()
    return process
