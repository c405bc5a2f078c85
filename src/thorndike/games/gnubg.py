"""GNU Backgammon, asked through its command line: it is told a position and a throw, and hints at the best move of all checkers.

A ply here is one checker's move, so that a hint is played over the plies of the throw. It plays for points without a doubling cube, as the
games here do: a gammon counts two, a backgammon three.
"""

import base64
import re
import time
from collections.abc import Sequence
from functools import cache
from itertools import pairwise

import jax
import numpy as np

from thorndike.errors import UserError
from thorndike.games.engine_player import Answered, Dialogue, Start, started
from thorndike.games.engine_process import EngineProcess
from thorndike.games.game import Game, Position, Turn

_BAR = 25
_NAMED = {"bar": _BAR, "off": 0}
_BEGIN = (
    "set automatic roll off",
    "set automatic game off",
    "set automatic bearoff off",
    "set automatic move off",
    "set player 0 human",
    "set player 1 human",
    "set cube use off",
    "set jacoby off",
    "set display off",
    "set evaluation chequerplay evaluation cubeful off",
)
_HINT = re.compile(r"\s*1\.\s+Cube\w+ \d-ply\s+(.+?)\s+Eq\.:")
_CHANCES = re.compile(r"\s*([01]\.\d+) ")
Hop = tuple[int, int]
"""From and to, as the mover counts points: 25 is the bar, 0 home."""


def gnubg_start(command: tuple[str, ...], plies: int, move_limit_s: float) -> Start:
    """How to start it, to look ``plies`` throws ahead; it is given up on if a move takes longer than ``move_limit_s``."""

    def start() -> Dialogue:
        planned: dict[tuple[int, ...], Answered] = {}
        """What is to be played after these moves."""

        def prepare(process: EngineProcess) -> None:
            for line in (*_BEGIN, f"set evaluation chequerplay evaluation plies {plies}", "new session", "set turn 1"):
                process.send(line)

        process = started(command, prepare)

        def hint(position: Position) -> tuple[str, float]:
            first, second = (int(die) + 1 for die in np.asarray(position._dice))
            for line in (f"set board {position_id(np.asarray(position._board))}", f"set dice {first} {second}", "hint 1"):
                process.send(line)
            until = time.monotonic() + move_limit_s
            while (found := _HINT.match(process.line(until))) is None:
                pass
            while (chances := _CHANCES.match(process.line(until))) is None:
                pass
            return found[1], float(chances[1])

        def ask(turn: Turn) -> Answered:
            process.stopped = turn.stopped
            if turn.moves not in planned:
                if np.asarray(turn.game.legal(turn.position))[0]:
                    return Answered("pass")
                if int(turn.position._played_dice_num) > 0:
                    raise UserError("gnubg moves all checkers of a throw, and part of this one is played: ask it at the next throw")
                text, chance = hint(turn.position)
                actions = actions_of(turn.game, turn.position, hops_of(text))
                if actions is None:
                    return Answered(text)
                planned.clear()
                position, moves = turn.position, turn.moves
                for action in actions:
                    planned[moves] = Answered(turn.game.action_name(position, action), chance)
                    position, moves = _stepped(turn.game, position, action), (*moves, action)
            return planned[turn.moves]

        # It asks whether to leave a game that is under way.
        return Dialogue(ask, lambda: process.close("quit\ny"))

    return start


def position_id(board: np.ndarray) -> str:
    """GNU Backgammon's name of a board of pgx: for either side, the opponent first, a one a checker and a zero after every point."""
    other = [*(max(-int(n), 0) for n in board[:24]), -int(board[25])]
    mover = [*(max(int(n), 0) for n in board[23::-1]), int(board[24])]
    bits = "".join("1" * count + "0" for count in (*other, *mover)).ljust(80, "0")
    return base64.b64encode(int(bits[::-1], 2).to_bytes(10, "little")).decode().rstrip("=")


def hops_of(text: str) -> list[Hop]:
    """``bar/20* 13/7(2) 24/18/14`` as single hops, of one die or of several."""
    hops: list[Hop] = []
    for part in text.replace("*", "").split():
        path, _, times = part.partition("(")
        points = [_NAMED[point] if point in _NAMED else int(point) for point in path.split("/")]
        hops += list(pairwise(points)) * int(times.rstrip(")") or 1)
    return hops


def actions_of(game: Game, position: Position, hops: Sequence[Hop]) -> tuple[int, ...] | None:
    """Legal actions of backgammon, one after another, that make these hops and leave no die that could be played; None if none do.

    ``5/off`` may mean a five, or a four and then whatever bears off from the ace point: by the second, both dice are played.
    """
    dice = [int(die) + 1 for die in np.asarray(position._playable_dice) if die >= 0]
    return _search(game, position, list(hops), dice)


def _search(game: Game, position: Position, hops: list[Hop], dice: list[int]) -> tuple[int, ...] | None:
    legal = np.asarray(_compiled(game)[0](position))
    if not hops:
        return () if not dice or legal[0] or bool(position.terminated) else None
    for number, (start, end) in enumerate(hops):
        for die in sorted(set(dice), reverse=True):
            to, action = max(start - die, 0), (1 if start == _BAR else 26 - start) * 6 + die - 1
            if to < end or not legal[action]:
                continue
            rest = [*hops[:number], *([(to, end)] if to > end else []), *hops[number + 1 :]]
            left = list(dice)
            left.remove(die)
            found = _search(game, _stepped(game, position, action), rest, left)
            if found is not None:
                return (action, *found)
    return None


@cache
def _compiled(game: Game) -> tuple:
    return jax.jit(game.legal), jax.jit(game.step)


def _stepped(game: Game, position: Position, action: int) -> Position:
    """Within a throw; the next one's dice are looked at by nobody."""
    return _compiled(game)[1](position, np.int32(action), jax.random.key(0))
