"""Matches whose games are all played at once: a network asked about many positions together answers each some ten times faster than alone.

The games are those of `thorndike arena`: the same openings, each twice, with colours swapped.
"""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import thorndike as td
from thorndike.api.building import build_algorithm
from thorndike.games.engines import engine
from thorndike.games.environment import observed_position
from thorndike.games.game import Game, Player, Position, Turn
from thorndike.games.match import compiled, openings
from thorndike.games.search import SearchSettings, by_playouts, search
from thorndike.networks.masking import FORBIDDEN

TOGETHER = 50
"""Positions that are searched at once, where nobody says otherwise: half of the games of a match wait for the same player."""
RESIGNS = -1
"""In place of a move: the game is lost."""
Answer = Callable[[Sequence[Turn]], list[int]]


class Side(NamedTuple):
    """A player who is asked about many positions at once."""

    name: str
    answer: Answer
    close: Callable[[], None] = lambda: None


def run_side(name: str, game: Game, run: Path, simulations: int) -> Side:
    """A run, or a folder that holds its policy."""
    loaded = td.load(run)
    policy = loaded.policy
    algorithm = build_algorithm("alphazero", {**loaded.facts["config"], "eval_simulations": simulations}, policy.spec, None)
    actor = jax.tree.map(lambda leaf: leaf[policy.best], policy.actors)
    noise = policy.noise(jax.random.key(0), TOGETHER)
    observed = jax.vmap(lambda position: observed_position(game, position))
    decide = jax.jit(lambda actor, positions: algorithm.greedy(actor, algorithm.memory(TOGETHER), observed(positions), noise)[1])
    return Side(name, together(lambda positions, number: decide(actor, positions)))


def mcts_side(game: Game, simulations: int, size: int = TOGETHER) -> Side:
    """Plain tree search by random playouts; with 0, random moves."""
    settings, evaluate, base = SearchSettings("puct", simulations), by_playouts(game), jax.random.key(1)

    @jax.jit
    def decide(positions: Position, key: jax.Array) -> jax.Array:
        if simulations == 0:
            legal = jax.vmap(game.legal)(positions)
            return jax.random.categorical(key, jnp.where(legal, 0.0, FORBIDDEN))
        return search(game, evaluate, settings, (), positions, key, explore=False).action

    name = f"mcts:simulations={simulations}" if simulations else "random"
    return Side(name, together(lambda positions, number: decide(positions, jax.random.fold_in(base, number)), size))


def engine_side(text: str, game: Game) -> Side:
    """A program of somebody else's, asked about one position after another."""
    player: Player = engine(text, game.id)

    def answer(turns: Sequence[Turn]) -> list[int]:
        choices = [player.choose(turn) for turn in turns]
        for choice in choices:
            if choice.resigns:
                print(choice.remark, flush=True)
        return [RESIGNS if choice.resigns else choice.action for choice in choices]

    return Side(text, answer, player.close)


def together(decide: Callable[[Position, int], jax.Array], size: int = TOGETHER) -> Answer:
    """``decide``: ``size`` positions and how often it was asked -> moves. The last ones are searched beside copies."""
    asked = 0

    def answer(turns: Sequence[Turn]) -> list[int]:
        nonlocal asked
        actions: list[int] = []
        for begin in range(0, len(turns), size):
            part = [turn.position for turn in turns[begin : begin + size]]
            filled = part + [part[0]] * (size - len(part))
            positions = jax.tree.map(lambda *leaves: np.stack(leaves), *filled)
            asked += 1
            actions += np.asarray(decide(positions, asked))[: len(part)].tolist()
        return actions

    return answer


class Played(NamedTuple):
    """A match of the first player: what each game was worth, and the seconds a move that each player took (all its games together)."""

    scores: list[float]
    seconds_a_move: tuple[float, float]


def play(game: Game, first: Side, second: Side, games: int, plies: int, seed: int = 0) -> Played:
    """Game ``2k`` is begun by the first player, ``2k + 1`` from the same opening by the second.

    Who resigns, or forfeits as an engine does, has lost; any other illegal answer raises ValueError.
    """
    rules, key = compiled(game), jax.random.key(seed)
    begun = openings(rules, plies, seed)
    facts = jax.jit(jax.vmap(lambda p: (game.terminated(p), game.player(p), game.rewards(p)[0])))
    legal = jax.jit(jax.vmap(game.legal))

    @jax.jit
    @jax.vmap
    def step(position: Position, action: jax.Array, over: jax.Array) -> Position:
        return jax.tree.map(lambda new, old: jnp.where(over, old, new), game.step(position, action, key), position)

    positions = jax.tree.map(lambda x: np.repeat(np.asarray(x)[None], games, axis=0), rules.init(seed))
    moves: list[list[int]] = [[] for _ in range(games)]
    spent, asked, won_by = [0.0, 0.0], [0, 0], np.zeros(games)
    while True:
        ended, mover, reward = (np.asarray(x) for x in facts(positions))
        # By resignation: 1 for whoever moved first in the game, as the reward is.
        over, reward = ended | (won_by != 0), np.where(won_by != 0, won_by, reward)
        if over.all():
            break
        allowed, actions = np.asarray(legal(positions)), np.zeros(games, np.int32)
        due: tuple[list[int], list[int]] = ([], [])
        for i in np.flatnonzero(~over):
            opening = begun[i // 2 % len(begun)]
            if len(moves[i]) < len(opening):
                actions[i] = opening[len(moves[i])]
            else:
                due[(int(mover[i]) + i) % 2].append(int(i))
        for side, player in enumerate((first, second)):
            turns = [Turn(game, jax.tree.map(lambda x, i=i: x[i], positions), tuple(moves[i])) for i in due[side]]
            began = time.perf_counter()
            if turns:
                actions[due[side]] = player.answer(turns)
            spent[side] += time.perf_counter() - began
            asked[side] += len(turns)
        resigned = ~over & (actions == RESIGNS)
        won_by[resigned], over = np.where(mover[resigned] == 0, -1.0, 1.0), over | resigned
        for i in np.flatnonzero(~over):
            if not allowed[i, actions[i]]:
                raise ValueError(f"action {actions[i]} is not legal after {moves[i]}")
            moves[i].append(int(actions[i]))
        positions = jax.tree.map(np.asarray, step(positions, np.maximum(actions, 0), over))
    scores = [(1.0 + (float(reward[i]) if i % 2 == 0 else -float(reward[i]))) / 2 for i in range(games)]
    return Played(scores, (spent[0] / max(asked[0], 1), spent[1] / max(asked[1], 1)))
