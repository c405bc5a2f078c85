"""What a learner sees that is not told the rules: of a game its board and which moves are legal, of anything else all there is."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from jaxtyping import Array, Bool, PyTree

from thorndike.games.environment import BOARD, check_unchanged
from thorndike.games.game import Game
from thorndike.networks.masking import MASK, allowed, check_mask, has_mask
from thorndike.replay.unrolled import Unrolled
from thorndike.types import EnvSpec, Observation


class View(NamedTuple):
    """How observations are looked at."""

    actions: int

    space: gymnasium.Space
    """Of what is seen."""
    see: Callable[[Observation], Observation]
    """Observations with any leading axes -> what is seen of them."""
    legal: Callable[[Observation], Bool[Array, "B actions"]]
    """What is seen ``[B, ...]`` -> which actions are allowed."""
    turn: Callable[[Unrolled], Unrolled]
    """Sequences -> the same with each way to turn the board taking an equal part of them; as they are where there is none."""


def view_of(spec: EnvSpec, actions: int, symmetries: bool = True) -> View:
    """The view of an environment; ``symmetries``: of a game, its board turned and mirrored too.

    Raises ``UserError`` if its mask does not fit the actions, and for a game whose observations a wrapper changed.
    """
    space = spec.observation_space
    see: Callable[[Observation], Observation] = _as_it_is
    turn: Callable[[Unrolled], Unrolled] = _as_it_is
    if spec.game is not None:
        check_unchanged(spec, spec.game)
        size = int(np.prod(spec.game.observation_shape))
        space = spaces.Dict({BOARD: spaces.Box(-np.inf, np.inf, (size,), np.float32), MASK: spaces.MultiBinary(actions)})
        see = _board_and_mask
        turn = partial(turned, spec.game) if symmetries else _as_it_is
    if not has_mask(space):
        return View(actions, space, see, lambda seen: jnp.ones((jax.tree.leaves(seen)[0].shape[0], actions), bool), turn)
    check_mask(spec._replace(observation_space=space))
    return View(actions, space, see, allowed, turn)


def _as_it_is(seen: PyTree) -> PyTree:
    return seen


def _board_and_mask(obs: Observation) -> Observation:
    board = obs[BOARD]
    return {BOARD: board.reshape((*board.shape[:-3], -1)), MASK: obs[MASK]}


def turned(game: Game, batch: Unrolled) -> Unrolled:
    """Sequences ``[M]`` of a game, of which each way to turn the board takes an equal part; what is only valued stays as it is."""
    board, legal, action, policy = batch.obs[BOARD], batch.obs[MASK], batch.action, batch.policy
    ways = len(game.symmetries) + 1
    for i, symmetry in enumerate(game.symmetries, start=1):
        part, new_place = slice(i, None, ways), jnp.asarray(np.argsort(symmetry.actions), jnp.int32)
        boards = board[part].reshape((-1, *game.observation_shape))
        board = board.at[part].set(jax.vmap(symmetry.observation)(boards).reshape((boards.shape[0], -1)))
        legal, policy = legal.at[part].set(legal[part][:, symmetry.actions]), policy.at[:, part].set(policy[:, part][..., symmetry.actions])
        action = action.at[:, part].set(new_place[action[:, part]])
    return batch._replace(obs={BOARD: board, MASK: legal}, action=action, policy=policy)
