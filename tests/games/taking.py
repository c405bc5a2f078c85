"""A small game in which turns do not simply alternate: taking one to three of eight beads, and again after taking two."""

import jax
import jax.numpy as jnp

from thorndike.games.game import Board, Game

BEADS, MOST = 8, 3


def _after(position, action, key):
    """Takes 1 to 3 beads; who takes exactly two moves again, so that turns do not simply alternate."""
    del key
    beads = position["beads"] - action - 1
    again = (action == 1) & (beads > 0)
    player = jnp.where(again, position["player"], 1 - position["player"])
    return {"beads": beads.astype(jnp.int32), "player": player.astype(jnp.int32), "mover": position["player"]}


def _rewards(position):
    """Whoever takes the last bead wins two points."""
    won = jnp.where(jnp.arange(2) == position["mover"], 2.0, -2.0)
    return jnp.where(position["beads"] == 0, won, 0.0)


TAKING = Game(
    id="taking",
    num_actions=MOST,
    observation_shape=(1, 1, BEADS),
    max_moves=BEADS,
    init=lambda key: {"beads": jnp.int32(BEADS), "player": jnp.int32(0), "mover": jnp.int32(0)},
    step=_after,
    legal=lambda position: position["beads"] > jnp.arange(MOST),
    player=lambda position: position["player"],
    terminated=lambda position: position["beads"] == 0,
    rewards=_rewards,
    observe=lambda position: jax.nn.one_hot(position["beads"] - 1, BEADS)[None, None],
    board=lambda position: Board((("",),), ("",), ("",), {}, {}),
    action_name=lambda position, action: str(action + 1),
)
