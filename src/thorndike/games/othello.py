"""Othello: a stone encloses the other's stones in straight lines and turns them; whoever has more in the end has won.

A player's 64 squares are bits of two words, row by row from the top left, which a search copies at every node; lines are followed by
shifting all squares at once, as in Gunnar Andersson's and others' boards. A player who can enclose nothing passes; two passes, a full
board or no stones of the mover's end the game, as in pgx, against whose rules these are tested.
"""

from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Int32, Key, UInt32

from thorndike.games.game import Board, Game, Position, Square
from thorndike.games.turning import turned_board

_SIZE, _SQUARES, _PASS = 8, 64, 64
_NAMES = (*(f"{column}{row}" for row in range(1, 9) for column in "abcdefgh"), "pass")
_LEFT = np.array([1, 7, 8, 9, 0, 0, 0, 0], np.uint32)
_RIGHT = np.array([0, 0, 0, 0, 1, 7, 8, 9], np.uint32)
"""The eight directions, as bits that words are shifted by towards the last square, and towards the first."""
_EDGES = np.array([0x7E7E7E7E, 0x7E7E7E7E, 0xFFFFFFFF, 0x7E7E7E7E] * 2, np.uint32)
"""Where stones lie that a line of each direction can turn: not on the edges that its shifts would run round."""
_ALL = np.uint32(0xFFFFFFFF)
_LONGEST = 6
"""Stones turned in one line."""
_BIT = np.arange(32, dtype=np.uint32)
_BEGIN = np.array([[1 << 28, 1 << 3], [1 << 27, 1 << 4]], np.uint32)
"""Black's d5 and e4, white's d4 and e5 by word: the third and the fourth row meet where the words do."""

Words: TypeAlias = UInt32[Array, " 2"]
"""Rows 1 to 4, rows 5 to 8."""
Lines: TypeAlias = UInt32[Array, "2 8"]
"""By word and direction."""


class OthelloPosition(NamedTuple):
    """Where each player's stones are, and whose turn it is."""

    stones: UInt32[Array, "2 2"]
    """By player, then word."""
    mover: Int32[Array, ""]
    passes: Int32[Array, ""]
    """Passes in succession; two end the game."""


def _init(key: Key[Array, ""]) -> OthelloPosition:
    return OthelloPosition(jnp.asarray(_BEGIN), jnp.int32(0), jnp.int32(0))


def _step(position: OthelloPosition, action: Int[Array, ""], key: Key[Array, ""]) -> OthelloPosition:
    mine, theirs = _sides(position)
    passes = action == _PASS
    bit = jnp.uint32(1) << (action % 32).astype(jnp.uint32)
    placed = jnp.where((jnp.arange(2) == action // 32), bit, jnp.uint32(0))
    line = _lines(placed, theirs)
    closed = jnp.any(_shifted(line) & mine[:, None] != 0, axis=0)
    turned = _any(jnp.where(closed, line, jnp.uint32(0)))
    new_mine, new_theirs = mine | placed | turned, theirs & ~turned
    stones = jnp.where(position.mover == 0, jnp.stack([new_mine, new_theirs]), jnp.stack([new_theirs, new_mine]))
    return OthelloPosition(stones, 1 - position.mover, jnp.where(passes, position.passes + 1, 0))


def _legal(position: OthelloPosition) -> Bool[Array, " 65"]:
    mine, theirs = _sides(position)
    found = _any(_shifted(_lines(mine, theirs))) & ~(mine | theirs)
    return jnp.append(_bits(found) > 0, jnp.all(found == 0))


def _terminated(position: OthelloPosition) -> Bool[Array, ""]:
    full = jnp.all(position.stones[0] | position.stones[1] == _ALL)
    wiped_out = jnp.any(jnp.all(position.stones == 0, axis=1))
    return full | wiped_out | (position.passes > 1)


def _rewards(position: OthelloPosition) -> Float[Array, " 2"]:
    counts = jnp.sum(jax.lax.population_count(position.stones), axis=1).astype(jnp.int32)
    lead = jnp.where(_terminated(position), jnp.sign(counts[0] - counts[1]), 0).astype(jnp.float32)
    return jnp.stack([lead, -lead])


def _observe(position: OthelloPosition) -> Float[Array, "8 8 2"]:
    """The mover's stones, the other's."""
    own = jnp.where(position.mover == 0, position.stones, position.stones[::-1])
    return jnp.stack([_bits(own[0]), _bits(own[1])], axis=-1).astype(jnp.float32).reshape(_SIZE, _SIZE, 2)


def _ownership(position: OthelloPosition) -> Float[Array, "8 8"]:
    black, white = (_bits(stones).astype(jnp.float32) for stones in position.stones)
    return (black - white).reshape(_SIZE, _SIZE)


def _sides(position: OthelloPosition) -> tuple[Words, Words]:
    """The mover's stones, the other's."""
    first = position.mover == 0
    return jnp.where(first, position.stones[0], position.stones[1]), jnp.where(first, position.stones[1], position.stones[0])


def _lines(begin: Words, theirs: Words) -> Lines:
    """In each direction the other's stones that lie one behind another next to ``begin``."""
    among = theirs[:, None] & _EDGES[None]
    found = _shifted(jnp.broadcast_to(begin[:, None], (2, 8))) & among
    for _ in range(_LONGEST - 1):
        found |= _shifted(found) & among
    return found


def _shifted(lines: Lines) -> Lines:
    """64 bits of each direction, one square on."""
    low, high = lines
    return jnp.stack([low << _LEFT >> _RIGHT | high << (32 - _RIGHT), high << _LEFT >> _RIGHT | low >> (32 - _LEFT)])


def _any(lines: Lines) -> Words:
    return jax.lax.reduce_or(lines, axes=(1,))


def _bits(words: Words) -> UInt32[Array, " 64"]:
    return (words[:, None] >> _BIT[None] & jnp.uint32(1)).reshape(_SQUARES)


def _board(position: OthelloPosition) -> Board:
    stones = np.asarray(jnp.stack([_bits(position.stones[0]), _bits(position.stones[1])]))
    marks = ["X" if black else "O" if white else "" for black, white in stones.T]
    legal = [] if bool(_terminated(position)) else np.flatnonzero(np.asarray(_legal(position))).tolist()
    rows = tuple(tuple(marks[i : i + _SIZE]) for i in range(0, _SQUARES, _SIZE))
    clicks: dict[tuple[Square, ...], int] = {(divmod(action, _SIZE),): action for action in legal if action != _PASS}
    return Board(rows, tuple("12345678"), tuple("abcdefgh"), clicks, {"pass": _PASS} if _PASS in legal else {})


def _action_name(position: Position, action: int) -> str:
    """Column and row, as ``d3``, or ``pass``."""
    return _NAMES[action]


OTHELLO = Game(
    id="othello",
    num_actions=_SQUARES + 1,
    observation_shape=(_SIZE, _SIZE, 2),
    max_moves=128,  # 60 squares, and less than one pass for each
    init=_init,
    step=_step,
    legal=_legal,
    player=lambda position: position.mover,
    terminated=_terminated,
    rewards=_rewards,
    observe=_observe,
    board=_board,
    action_name=_action_name,
    # A quarter turn of the beginning exchanges the colours: no game looks like that.
    symmetries=(turned_board(_SIZE, 2, False), turned_board(_SIZE, 1, True), turned_board(_SIZE, 3, True)),
    ownership=_ownership,
)
