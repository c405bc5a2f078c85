"""MinAtar Space Invaders: shoot aliens that come down and shoot back (Young and Tian, 2019; rules of minatar 1.0.15).

Each alien is worth 1. It ends when a bullet or an alien reaches the cannon, or aliens at the bottom turn. Fewer aliens are faster, and
each new wave is faster than the last until the seventh, unless `difficulty_ramping` is false. Nothing is random but sticky actions.
Channels: cannon, aliens, aliens that go left, aliens that go right, own bullets, theirs.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int32

from thorndike.environments.native.minatar.game import FIRE, LAST, LEFT, NOOP, RIGHT, SIZE, Game, bits, board, cells, dynamics, move, places
from thorndike.environments.native.randomness import no_noise
from thorndike.environments.native.vectorize import Dynamics

SHOT_INTERVAL = 5
ALIEN_INTERVAL = 12
SHORTEST_INTERVAL = 6
ALIEN_SHOT_INTERVAL = 10
ROW = 2**SIZE - 1
WAVE_ROWS = 4
WAVE_ROW = 0b0011111100
"""Columns 2 to 7."""


class State(NamedTuple):
    """Three boards as one word a row, bit = column; the cannon, and clocks that count down."""

    x: Int32[Array, "*batch"]
    own: Int32[Array, "*batch 10"]
    theirs: Int32[Array, "*batch 10"]
    aliens: Int32[Array, "*batch 10"]
    right: Bool[Array, "*batch"]
    interval: Int32[Array, "*batch"]
    """Steps between two moves of a large wave."""
    move_timer: Int32[Array, "*batch"]
    alien_shot_timer: Int32[Array, "*batch"]
    shot_timer: Int32[Array, "*batch"]


def space_invaders(*, sticky_action_prob: float = 0.1, difficulty_ramping: bool = True) -> Dynamics:
    """MinAtar/SpaceInvaders-v0: six actions."""
    return dynamics(SPACE_INVADERS._replace(play=partial(play, ramping=difficulty_ramping)), 0, sticky_action_prob)


def space_invaders_minimal(*, sticky_action_prob: float = 0.1, difficulty_ramping: bool = True) -> Dynamics:
    """MinAtar/SpaceInvaders-v1: stay, left, right, fire."""
    return dynamics(SPACE_INVADERS._replace(play=partial(play, ramping=difficulty_ramping)), 1, sticky_action_prob)


def reset(noise: tuple[()]) -> State:
    """The cannon in the middle, and the first wave."""
    del noise
    nothing = jnp.zeros(SIZE, jnp.int32)
    return State(
        x=jnp.int32(5),
        own=nothing,
        theirs=nothing,
        aliens=wave(nothing),
        right=jnp.bool_(False),
        interval=jnp.int32(ALIEN_INTERVAL),
        move_timer=jnp.int32(ALIEN_INTERVAL),
        alien_shot_timer=jnp.int32(ALIEN_SHOT_INTERVAL),
        shot_timer=jnp.int32(0),
    )


def play(
    state: State, action: Int32[Array, "*batch"], numbers: Float[Array, "*batch N"], *, ramping: bool = True
) -> tuple[State, Float[Array, "*batch"], Bool[Array, "*batch"]]:
    """One step: cannon, bullets, aliens, their shot, what own bullets hit."""
    del numbers
    fired = (action == FIRE) & (state.shot_timer == 0)
    x = move(state.x, action == RIGHT, action == LEFT)
    # A shot leaves from the bottom row and moves up at once.
    own = down(state.own, -1) | jnp.where(fired[..., None] & (places(x, SIZE) == LAST - 1), jnp.int32(1) << x[..., None], 0)
    theirs = down(state.theirs, 1)
    dead = at_cannon(theirs, x) | at_cannon(state.aliens, x)
    aliens, right, crashed = march(state, x)
    shooting = state.alien_shot_timer == 0
    theirs = theirs | jnp.where(shooting[..., None], shot(aliens, x), 0)
    killed = aliens & own
    aliens = aliens & ~killed
    cleared = jnp.all(aliens == 0, axis=-1)
    faster = cleared & (state.interval > SHORTEST_INTERVAL) if ramping else jnp.zeros_like(cleared)
    marched = jnp.where(state.move_timer == 0, jnp.minimum(count(state.aliens), state.interval), state.move_timer)
    after = State(
        x=x,
        own=own & ~killed,
        theirs=theirs,
        aliens=jnp.where(cleared[..., None], wave(aliens), aliens),
        right=right,
        interval=state.interval - faster.astype(jnp.int32),
        move_timer=marched - 1,
        alien_shot_timer=jnp.where(shooting, ALIEN_SHOT_INTERVAL, state.alien_shot_timer) - 1,
        shot_timer=jnp.maximum(jnp.where(fired, SHOT_INTERVAL, state.shot_timer) - 1, 0),
    )
    return after, count(killed).astype(jnp.float32), dead | crashed


def march(state: State, x: Int32[Array, "*batch"]) -> tuple[Int32[Array, "*batch 10"], Bool[Array, "*batch"], Bool[Array, "*batch"]]:
    """Aliens after their move if it is time, whether they go right, and whether that ends the game.

    At a wall they turn and come one row down; those of the bottom row appear at the top, in the picture of the end.
    """
    moving = state.move_timer == 0
    wall = jnp.where(state.right, jnp.int32(1 << LAST), jnp.int32(1))
    turning = jnp.any((state.aliens & wall[..., None]) != 0, axis=-1)
    aside = jnp.where(state.right[..., None], (state.aliens << 1) & ROW, state.aliens >> 1)
    moved = jnp.where(turning[..., None], jnp.roll(state.aliens, 1, axis=-1), aside)
    aliens = jnp.where(moving[..., None], moved, state.aliens)
    crashed = (turning & (state.aliens[..., LAST] != 0)) | at_cannon(moved, x)
    return aliens, state.right ^ (moving & turning), moving & crashed


def shot(aliens: Int32[Array, "*batch 10"], x: Int32[Array, "*batch"]) -> Int32[Array, "*batch 10"]:
    """The bullet of the lowest alien in the column nearest to the cannon; of two as near, the left one."""
    column, row = places(x, SIZE), places(x, SIZE)
    occupied = jnp.any(bits(aliens), axis=-2)
    distance = jnp.where(occupied, 2 * jnp.abs(column - x[..., None]) + (column > x[..., None]), 2 * SIZE)
    nearest = jnp.min(distance, axis=-1)
    aimed = x + jnp.where((nearest & 1) == 1, nearest >> 1, -(nearest >> 1))
    bit = (jnp.int32(1) << aimed)[..., None]
    lowest = jnp.max(jnp.where((aliens & bit) != 0, row, -1), axis=-1)
    return jnp.where(row == lowest[..., None], bit, 0)


def down(rows: Int32[Array, "*batch 10"], by: int) -> Int32[Array, "*batch 10"]:
    """Every row one further down (1) or up (-1); what leaves the board is gone."""
    ends = [(0, 0)] * (rows.ndim - 1)
    return jnp.pad(rows[..., :-1], [*ends, (1, 0)]) if by == 1 else jnp.pad(rows[..., 1:], [*ends, (0, 1)])


def at_cannon(rows: Int32[Array, "*batch 10"], x: Int32[Array, "*batch"]) -> Bool[Array, "*batch"]:
    """Whether something is where the cannon is."""
    return ((rows[..., LAST] >> x) & 1) == 1


def count(rows: Int32[Array, "*batch 10"]) -> Int32[Array, "*batch"]:
    """How many cells are set."""
    return jnp.sum(jax.lax.population_count(rows), axis=-1, dtype=jnp.int32)


def wave(like: Int32[Array, "*batch 10"]) -> Int32[Array, "*batch 10"]:
    """A new wave of aliens."""
    row = jnp.arange(SIZE, dtype=jnp.int32).reshape((1,) * (like.ndim - 1) + (SIZE,))
    return jnp.broadcast_to(jnp.where(row < WAVE_ROWS, jnp.int32(WAVE_ROW), jnp.int32(0)), like.shape)


def observe(state: State) -> Bool[Array, "... 10 10 6"]:
    """Cannon, aliens, aliens that go left, aliens that go right, own bullets, theirs."""
    aliens, right = bits(state.aliens), state.right[..., None, None]
    cannon = cells(jnp.full_like(state.x, LAST), state.x)
    return board(cannon, aliens, aliens & ~right, aliens & right, bits(state.own), bits(state.theirs))


SPACE_INVADERS = Game("SpaceInvaders", 6, (NOOP, LEFT, RIGHT, FIRE), reset, no_noise, observe, play, numbers=0)
