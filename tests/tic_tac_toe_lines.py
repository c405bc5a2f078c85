"""All of tic-tac-toe in slow Python: its positions, their values, and every line that an agent's answers leave open."""

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import thorndike as td
from thorndike.api.building import build_algorithm
from thorndike.games.environment import observed_position
from thorndike.games.tic_tac_toe import TIC_TAC_TOE, TicTacToePosition

SIDE_BY_SIDE = 64
"""Positions that are decided together."""
Pieces = tuple[int, int]
"""The bits of each player."""
Choose = Callable[[TicTacToePosition], np.ndarray]
"""Positions ``[B]`` -> moves."""
_LINES = [sum(1 << i for i in line) for line in ((0, 1, 2), (3, 4, 5), (6, 7, 8), (0, 3, 6), (1, 4, 7), (2, 5, 8), (0, 4, 8), (2, 4, 6))]


class Lines(NamedTuple):
    """How many lines of play ended how for the agent."""

    won: int
    drawn: int
    lost: int


def mover(pieces: Pieces) -> int:
    return (pieces[0] | pieces[1]).bit_count() % 2


def moves(pieces: Pieces) -> list[int]:
    return [i for i in range(9) if not (pieces[0] | pieces[1]) >> i & 1]


def after(pieces: Pieces, move: int) -> Pieces:
    return (pieces[0] | 1 << move, pieces[1]) if mover(pieces) == 0 else (pieces[0], pieces[1] | 1 << move)


def result(pieces: Pieces) -> int | None:
    """For player 0; None while the game goes on."""
    for player in (0, 1):
        if any(pieces[player] & line == line for line in _LINES):
            return 1 - 2 * player
    return None if moves(pieces) else 0


@cache
def value(pieces: Pieces) -> int:
    """For player 0, both playing perfectly."""
    known = result(pieces)
    if known is not None:
        return known
    values = [value(after(pieces, move)) for move in moves(pieces)]
    return max(values) if mover(pieces) == 0 else min(values)


def states() -> list[Pieces]:
    """Every position that can come about and goes on."""
    seen, waiting = {(0, 0)}, [(0, 0)]
    while waiting:
        pieces = waiting.pop()
        for move in moves(pieces):
            following = after(pieces, move)
            if following not in seen and result(following) is None:
                seen.add(following)
                waiting.append(following)
    return sorted(seen)


def batch(positions: list[Pieces]) -> TicTacToePosition:
    return TicTacToePosition(jnp.asarray(positions, jnp.uint32))


def choose_in_parts(choose: Choose, positions: list[Pieces], size: int = SIDE_BY_SIDE) -> np.ndarray:
    """Moves of any number of positions, a fixed number at a time: one compiled program."""
    filled = [*positions, *[(0, 0)] * (-len(positions) % size)]
    parts = [np.asarray(choose(batch(filled[i : i + size]))) for i in range(0, len(filled), size)]
    return np.concatenate(parts)[: len(positions)]


def walk(choose: Choose, agent: int) -> Lines:
    """Every line: all the opponent's moves, and the agent's one answer to each."""
    found = {1: 0, 0: 0, -1: 0}
    level = {(0, 0): 1}
    while level:
        following: dict[Pieces, int] = {}
        own = [pieces for pieces in level if mover(pieces) == agent]
        answers = dict(zip(own, choose_in_parts(choose, own), strict=True)) if own else {}
        for pieces, count in level.items():
            for move in [int(answers[pieces])] if pieces in answers else moves(pieces):
                assert move in moves(pieces)
                reached = after(pieces, move)
                ended = result(reached)
                if ended is None:
                    following[reached] = following.get(reached, 0) + count
                else:
                    found[ended if agent == 0 else -ended] += count
        level = following
    return Lines(found[1], found[0], found[-1])


def chooser(run: Path, simulations: int, seed: int = 0) -> Choose:
    """The policy of a run, with that many simulations a move where it searches."""
    loaded = td.load(run)
    policy, facts = loaded.policy, loaded.facts
    searches = {"eval_simulations": simulations} if "eval_simulations" in facts["config"] else {}
    algorithm = build_algorithm(facts["algorithm"], facts["config"] | searches, policy.spec, None)
    actor, noise = jax.tree.map(lambda leaf: leaf[seed], policy.actors), policy.noise(jax.random.key(0), SIDE_BY_SIDE)
    see = jax.vmap(lambda position: observed_position(TIC_TAC_TOE, position))
    return jax.jit(lambda positions: algorithm.greedy(actor, algorithm.memory(SIDE_BY_SIDE), see(positions), noise)[1])


def optimal_share(choose: Choose) -> float:
    """Of all positions, those in which the move keeps the value."""
    positions = states()
    chosen = choose_in_parts(choose, positions)
    return float(np.mean([value(after(pieces, int(move))) == value(pieces) for pieces, move in zip(positions, chosen, strict=True)]))


def perfect_evaluation():
    """Positions -> no preference among moves, and their true values."""
    table = np.zeros((512, 512), np.float32)
    for pieces in states():
        table[pieces] = value(pieces) * (1 if mover(pieces) == 0 else -1)
    flat = jnp.asarray(table.reshape(-1))

    def evaluate(params, positions, key):
        del params, key
        index = (positions.pieces[:, 0] * 512 + positions.pieces[:, 1]).astype(jnp.int32)
        return jnp.zeros((index.shape[0], 9)), flat[index]

    return evaluate
