"""A small game that squares decide: tic-tac-toe, where the winner's pieces are his squares, and all others are nobody's."""

import jax.numpy as jnp

from thorndike.games.tic_tac_toe import TIC_TAC_TOE


def _ownership(position):
    own = (position.pieces[:, None] >> jnp.arange(9)[None]) & 1
    won = (TIC_TAC_TOE.rewards(position) > 0)[:, None]
    return jnp.where(won[0], own[0], jnp.where(won[1], -own[1], 0)).astype(jnp.float32).reshape(3, 3)


SQUARES = TIC_TAC_TOE._replace(id="squares", ownership=_ownership)
