"""What a learner sees that is not told the rules: of a game its board and which moves are legal, of anything else all there is."""

from collections.abc import Callable
from typing import NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from jaxtyping import Array, Bool

from thorndike.games.environment import BOARD
from thorndike.networks.masking import MASK, allowed, check_mask, has_mask
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


def view_of(spec: EnvSpec, actions: int) -> View:
    """The view of an environment. Raises ``UserError`` if its mask does not fit the actions."""
    space, see = spec.observation_space, _all_of_it
    if spec.game is not None:
        size = int(np.prod(spec.game.observation_shape))
        space = spaces.Dict({BOARD: spaces.Box(-np.inf, np.inf, (size,), np.float32), MASK: spaces.MultiBinary(actions)})
        see = _board_and_mask
    if not has_mask(space):
        return View(actions, space, see, lambda seen: jnp.ones((jax.tree.leaves(seen)[0].shape[0], actions), bool))
    check_mask(spec._replace(observation_space=space))
    return View(actions, space, see, allowed)


def _all_of_it(obs: Observation) -> Observation:
    return obs


def _board_and_mask(obs: Observation) -> Observation:
    board = obs[BOARD]
    return {BOARD: board.reshape((*board.shape[:-3], -1)), MASK: obs[MASK]}
