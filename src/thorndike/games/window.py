"""The window of self-play: the latest positions of games, kept to learn from."""

import math

import jax.numpy as jnp

from thorndike.games.board_heads import endings_of
from thorndike.games.game import Game
from thorndike.games.packing import packing
from thorndike.games.turns import players
from thorndike.networks.masking import POSITION
from thorndike.replay.self_play import Rows, SelfPlayBuffer, add_self_play, init_self_play
from thorndike.types import Rollout


def empty_window(game: Game, size: int, moves: int, games: int, endings: bool) -> SelfPlayBuffer:
    """One for at least ``size`` positions, and a longest game beside the ``moves`` that are written at once of each of the ``games``.

    With ``endings`` it keeps how boards looked when games ended.
    """
    least = (moves + game.max_moves) * games
    steps = math.ceil(max(size, least) / (moves * games)) * moves
    board = game.observation_shape[:2] if endings else None
    return init_self_play(steps, games, packing(game).size, game.num_actions, board)


def into_window(game: Game, window: SelfPlayBuffer, rollout: Rollout) -> SelfPlayBuffer:
    """The rollout's positions in place of the oldest, and the outcomes of the games that ended."""
    step, extras, positions = rollout.step, rollout.extras, rollout.obs[POSITION]
    nothing, movers = jnp.zeros(step.reward.shape), players(game, positions)
    ending = None if window.rows.ending is None else endings_of(game, rollout)
    new = Rows(positions, movers, extras["policy"], extras["policy_weight"], nothing, nothing > 0, extras["resigns"], ending)
    return add_self_play(window, new, step.reward, step.done, game.max_moves)
