"""Go as a player looks at it: whose stones are short of liberties, what was played last, where one may play.

pgx shows the stones of the last eight positions and leaves it to the network to count liberties, which a small one takes long to learn.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from thorndike.games.game import Position

FEW = 3
"""Liberties are few up to here, each counted once for every stone of the group beside it."""


def seen_by_mover(position: Position) -> Float[Array, "size size 12"]:
    """The mover's stones, the other's; which of them have one liberty, which few; the other's last stone, the mover's; where one may play;
    whether the mover is white, whether the other passed, and ones, so that a convolution knows the edge."""
    go = position._x
    squares = go.board.shape[0]
    size = int(np.sqrt(squares))
    sign = 1 - 2 * (go.step_count % 2)
    mine, theirs = go.board * sign > 0, go.board * sign < 0
    one, few = short_of_liberties(go.board, size)
    before = go.board_history * sign
    planes = [mine, theirs, mine & one, theirs & one, mine & few, theirs & few]
    planes += [(before[0] == -1) & (before[1] != -1), mine & (before[1] == 1) & (before[2] != 1), position.legal_action_mask[:squares]]
    planes += [jnp.full(squares, sign < 0), jnp.full(squares, go.consecutive_pass_count > 0), jnp.ones(squares, bool)]
    return jnp.stack(planes, axis=-1).astype(jnp.float32).reshape(size, size, len(planes))


def short_of_liberties(board: Int[Array, " squares"], size: int) -> tuple[Int[Array, " squares"], Int[Array, " squares"]]:
    """Stones whose group has one liberty, and those whose group has more, but few; ``board`` has the same number for the stones of a group.

    A group has one liberty if all the empty points beside its stones are the same: if their places do not vary (pgx and OpenSpiel tell by
    one number of a place, whose squares grow too large on 19 x 19).
    """
    empty, at = (board == 0).astype(jnp.float32).reshape(size, size), jnp.arange(size, dtype=jnp.float32)
    row, column = jnp.meshgrid(at, at, indexing="ij")
    told = jnp.stack([empty, empty * row, empty * column, empty * (row**2 + column**2)], axis=-1)
    told = jnp.pad(told, ((1, 1), (1, 1), (0, 0)))
    beside = told[2:, 1:-1] + told[:-2, 1:-1] + told[1:-1, 2:] + told[1:-1, :-2]
    together = (board[:, None] == board[None, :]).astype(jnp.float32)
    # Whole numbers below 2^24, and products below 2^31.
    count, rows, columns, squares = (together @ beside.reshape(-1, 4)).astype(jnp.int32).T
    one = (board != 0) & (rows * rows + columns * columns == squares * count)
    return one, (board != 0) & ~one & (count <= FEW)
