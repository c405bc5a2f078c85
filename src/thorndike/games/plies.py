"""Positions of a game one after another, each with what people ask about it."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from thorndike.errors import UserError
from thorndike.games.game import Board, Game, Position, Square, Turn


class Ply(NamedTuple):
    """A position of the game, and what led there and is allowed there."""

    position: Position
    number: int
    """Moves before it."""
    board: Board
    legal: tuple[int, ...]
    """In order; empty when the game is over."""
    player: int
    rewards: tuple[float, ...]
    """Earned by the move that led here."""


def first_ply(game: Game, seed: int) -> Ply:
    """The beginning; ``seed`` throws the dice."""
    return _ply(game, game.init(jax.random.key(seed)), 0, (0.0,) * game.num_players)


def next_ply(game: Game, ply: Ply, action: int, seed: int) -> Ply:
    """What a legal move leads to."""
    position = jax.jit(game.step)(ply.position, jnp.int32(action), jax.random.fold_in(jax.random.key(seed), ply.number))
    return _ply(game, position, ply.number + 1, tuple(map(float, np.asarray(jax.jit(game.rewards)(position)))))


def _ply(game: Game, position: Position, number: int, rewards: tuple[float, ...]) -> Ply:
    over = bool(jax.jit(game.terminated)(position))
    legal = () if over else tuple(map(int, np.flatnonzero(np.asarray(jax.jit(game.legal)(position)))))
    return Ply(position, number, game.board(position), legal, int(jax.jit(game.player)(position)), rewards)


def target_square(game: Game, ply: Ply, action: int) -> Square | None:
    """Where a legal move puts something; None for one that is no click on the board."""
    clicked = [squares for squares, of in ply.board.clicks.items() if of == action]
    if not clicked:
        return None
    if len(clicked) == 1:
        return clicked[0][-1]
    # Many squares mean this move, as those of a column do: it is the one on which something appears.
    after = next_ply(game, ply, action, seed=0).board.rows
    changed = (
        squares[-1] for squares in clicked if after[squares[-1][0]][squares[-1][1]] != ply.board.rows[squares[-1][0]][squares[-1][1]]
    )
    return next(changed, clicked[0][-1])


def line_names(game: Game, ply: Ply, actions: Sequence[int], at_most: int) -> tuple[str, ...]:
    """The names of moves played one after another, as far as they are legal."""
    names: list[str] = []
    for action in actions[:at_most]:
        if action not in ply.legal:
            break
        names.append(game.action_name(ply.position, action))
        ply = next_ply(game, ply, action, seed=0)
    return tuple(names)


def positions_before(turn: Turn) -> tuple[Position, ...]:
    """Those in which the moves so far were played. Raises UserError where they were not kept, and dice were thrown."""
    if len(turn.earlier) == len(turn.moves):
        return turn.earlier
    if turn.game.has_chance:
        raise UserError(f"a player that remembers is to be told the earlier positions of {turn.game.id}: give Turn.earlier")
    key, found = jax.random.key(0), [turn.game.init(jax.random.key(0))]
    for action in turn.moves:
        found.append(jax.jit(turn.game.step)(found[-1], jnp.int32(action), key))
    return tuple(found[:-1])


_GAMES = 64
"""Games whose moves are remembered: matches may be played side by side."""


class MoveNames:
    """Who played what, by name: what is known of a game's moves so far is kept for the next question, of the games asked about last."""

    def __init__(self) -> None:
        """Nothing is known yet."""
        self._known: dict[tuple[int, ...], tuple[list[tuple[int, str]], Position]] = {}

    def __call__(self, turn: Turn) -> list[tuple[int, str]]:
        """Player and name of each move of a game without dice."""
        game, key = turn.game, jax.random.key(0)
        begun = next((moves for k in range(len(turn.moves), -1, -1) if (moves := turn.moves[:k]) in self._known), ())
        names, position = self._known.pop(begun) if begun else ([], game.init(key))
        for action in turn.moves[len(begun) :]:
            names.append((int(jax.jit(game.player)(position)), game.action_name(position, action)))
            position = jax.jit(game.step)(position, jnp.int32(action), key)
        self._known[turn.moves] = names, position
        if len(self._known) > _GAMES:
            del self._known[next(iter(self._known))]
        return list(names)
