"""A game that was played, in whatever file it is kept, and whether the rules allow it."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from thorndike.errors import UserError
from thorndike.games.game import Game, named_action


class GameRecord(NamedTuple):
    """Not yet checked against the rules."""

    game: str
    """Its id."""
    players: tuple[str, str]
    moves: tuple[tuple[int, str], ...]
    """Who played what, 0 or 1 and the move by its name."""
    result: tuple[float, float] | None = None
    """The rewards of both players; None where the game is not over or nobody tells."""


def record_actions(game: Game, record: GameRecord) -> list[int]:
    """The moves as actions. Raises UserError at the first one that the rules do not allow.

    Where a player can only pass, a file may leave that out.
    """
    key = jax.random.key(0)
    position, actions = game.init(key), list[int]()
    step, terminated, player = jax.jit(game.step), jax.jit(game.terminated), jax.jit(game.player)
    for number, (mover, name) in enumerate(record.moves, start=1):
        if len(actions) >= game.max_moves or bool(terminated(position)):
            raise UserError(f"move {number} of the record, {name}, comes after the end of the game")
        if int(player(position)) != mover:
            legal = np.flatnonzero(np.asarray(game.legal(position)))
            if len(legal) == 1 and game.action_name(position, int(legal[0])) == "pass":
                actions.append(int(legal[0]))
                position = step(position, jnp.int32(legal[0]), key)
        action = named_action(game, position, name) if int(player(position)) == mover else None
        if action is None:
            raise UserError(f"move {number} of the record, {name}, is not legal there")
        actions.append(action)
        position = step(position, jnp.int32(action), key)
    return actions


def result_of(game: Game, actions: Sequence[int]) -> tuple[float, float] | None:
    """The rewards that a game of these actions ended with, None if it is not over."""
    key = jax.random.key(0)
    position, step = game.init(key), jax.jit(game.step)
    for action in actions:
        position = step(position, jnp.int32(action), key)
    if not bool(game.terminated(position)):
        return None
    first, second = np.asarray(game.rewards(position)).tolist()
    return first, second
