"""Whose turn it is along the positions of games that were played."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

from thorndike.errors import UserError
from thorndike.games.game import Game
from thorndike.games.packing import packing
from thorndike.networks.masking import POSITION
from thorndike.types import EnvSpec, Rollout


def players(game: Game, positions: PyTree) -> Int[Array, "T B"]:
    """Who is to move in packed positions ``[T, B, words]``."""
    unpack = packing(game).unpack
    return jax.vmap(jax.vmap(lambda numbers: game.player(unpack(numbers))))(positions)


def game_of_two(spec: EnvSpec) -> Game | None:
    """The rules, where the environment is a game of two. Raises ``UserError`` if a wrapper hides whose turn it is."""
    game = spec.game
    if game is None or game.num_players != 2:
        return None
    if POSITION not in getattr(spec.observation_space, "spaces", {}):
        raise UserError(f"{spec.id} is learnt from its positions, which a wrapper hides: leave the wrapper out")
    return game


def turns(game: Game | None, rollout: Rollout) -> Float[Array, "T B"] | float:
    """1 where whoever moved moves again, as between two checkers of a throw, and -1 where the other one does; 1 where no two play."""
    if game is None:
        return 1.0
    mover, following = players(game, rollout.obs[POSITION]), players(game, rollout.step.next_obs[POSITION])
    return jnp.where(mover == following, 1.0, -1.0)
