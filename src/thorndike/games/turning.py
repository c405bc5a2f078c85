"""Square boards turned and mirrored."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thorndike.games.game import Symmetry


def turned_board(size: int, turns: int, mirrored: bool) -> Symmetry:
    """Of a board whose actions are its squares, row by row, and one more that is no square: mirrored first, then so many quarter turns."""

    def turned(squares: Float[Array, "height width channels"]) -> Float[Array, "height width channels"]:
        return jnp.rot90(squares[:, ::-1] if mirrored else squares, turns)

    numbers = np.arange(size * size).reshape(size, size)
    actions = np.rot90(numbers[:, ::-1] if mirrored else numbers, turns).reshape(-1)
    return Symmetry(turned, np.append(actions, size * size))
