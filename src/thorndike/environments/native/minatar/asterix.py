"""MinAtar Asterix: collect gold and evade enemies that cross the board in eight rows (Young and Tian, 2019; rules of minatar 1.0.15).

Gold is worth 1, an enemy ends it. Things appear and move faster every 102 steps, unless `difficulty_ramping` is false. Channels: player,
enemy, where a thing came from, gold.
"""

from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int32

from thorndike.environments.native.minatar.game import (
    DOWN,
    EMPTY,
    LAST,
    LEFT,
    NOOP,
    RIGHT,
    UP,
    Game,
    board,
    cells,
    columns,
    dynamics,
    inside,
    move,
    places,
    sign,
    whole,
)
from thorndike.environments.native.randomness import no_noise
from thorndike.environments.native.vectorize import Dynamics

ROWS = 8
"""Rows 1 to 8 hold one thing each."""
SPAWN_INTERVAL = 10
MOVE_INTERVAL = 5
RAMP_INTERVAL = 100
HIGHEST_LEVEL = 9


class State(NamedTuple):
    """The player, one thing a row, and clocks that count down."""

    x: Int32[Array, "*batch"]
    y: Int32[Array, "*batch"]
    thing: Int32[Array, "*batch 8"]
    """Column of the thing in each row, or EMPTY."""
    right: Bool[Array, "*batch 8"]
    gold: Bool[Array, "*batch 8"]
    spawn_timer: Int32[Array, "*batch"]
    move_timer: Int32[Array, "*batch"]
    ramp_timer: Int32[Array, "*batch"]
    level: Int32[Array, "*batch"]
    """0 to 9: things appear every ``10 - level`` steps and move every ``max(1, 5 - level // 2)``."""


def asterix(*, sticky_action_prob: float = 0.1, difficulty_ramping: bool = True) -> Dynamics:
    """MinAtar/Asterix-v0: six actions."""
    return dynamics(ASTERIX._replace(play=partial(play, ramping=difficulty_ramping)), 0, sticky_action_prob)


def asterix_minimal(*, sticky_action_prob: float = 0.1, difficulty_ramping: bool = True) -> Dynamics:
    """MinAtar/Asterix-v1: stay, left, up, right, down."""
    return dynamics(ASTERIX._replace(play=partial(play, ramping=difficulty_ramping)), 1, sticky_action_prob)


def reset(noise: tuple[()]) -> State:
    """The player in the middle of an empty board."""
    del noise
    nothing = jnp.zeros(ROWS, bool)
    return State(
        x=jnp.int32(5),
        y=jnp.int32(5),
        thing=jnp.full(ROWS, EMPTY, jnp.int32),
        right=nothing,
        gold=nothing,
        spawn_timer=jnp.int32(SPAWN_INTERVAL),
        move_timer=jnp.int32(MOVE_INTERVAL),
        ramp_timer=jnp.int32(RAMP_INTERVAL),
        level=jnp.int32(0),
    )


def play(
    state: State, action: Int32[Array, "*batch"], numbers: Float[Array, "*batch 3"], *, ramping: bool = True
) -> tuple[State, Float[Array, "*batch"], Bool[Array, "*batch"]]:
    """One step: something may appear, the player moves, meets things, they move, the player meets them again."""
    spawning, moving = state.spawn_timer == 0, state.move_timer == 0
    state = spawn(state, spawning, numbers)
    x, y = move(state.x, action == RIGHT, action == LEFT), move(state.y, action == DOWN, action == UP, 1, ROWS)
    in_row = (y - 1)[..., None] == places(y, ROWS)
    met = in_row & (state.thing == x[..., None])
    # A thing that leaves the board is in a column that is none.
    moved = jnp.where((met & state.gold) | ~inside(state.thing), EMPTY, state.thing + jnp.where(moving[..., None], sign(state.right), 0))
    met_again = in_row & (moved == x[..., None]) & moving[..., None]
    collected = jnp.sum(met & state.gold, axis=-1) + jnp.sum(met_again & state.gold, axis=-1)
    hit = jnp.any((met | met_again) & ~state.gold, axis=-1)
    after = state._replace(
        x=x,
        y=y,
        thing=jnp.where(met_again & state.gold, EMPTY, moved),
        spawn_timer=jnp.where(spawning, SPAWN_INTERVAL - state.level, state.spawn_timer) - 1,
        move_timer=jnp.where(moving, jnp.maximum(1, MOVE_INTERVAL - (state.level >> 1)), state.move_timer) - 1,
    )
    return (harder(after) if ramping else after), collected.astype(jnp.float32), hit


def spawn(state: State, spawning: Bool[Array, "*batch"], numbers: Float[Array, "*batch 3"]) -> State:
    """Gold, one time in three, or an enemy, at the left or right end of a row that is free, if there is one."""
    right, gold = numbers[..., 0] < 1 / 2, numbers[..., 1] < 1 / 3
    free = ~inside(state.thing)
    chosen = whole(numbers[..., 2], jnp.sum(free, axis=-1))
    row = places(chosen, ROWS)
    # How many rows above each one are free: the chosen row has as many as was drawn.
    above = jnp.sum(free[..., None, :] & (row[..., None, :] < row[..., :, None]), axis=-1)
    here = spawning[..., None] & free & (above == chosen[..., None])
    return state._replace(
        thing=jnp.where(here, jnp.where(right, 0, LAST)[..., None], state.thing),
        right=jnp.where(here, right[..., None], state.right),
        gold=jnp.where(here, gold[..., None], state.gold),
    )


def harder(state: State) -> State:
    """The clock of the difficulty, and one level more when it has run out."""
    due = state.ramp_timer < 0
    return state._replace(
        ramp_timer=jnp.where(due, RAMP_INTERVAL, state.ramp_timer - 1),
        level=jnp.minimum(state.level + due.astype(jnp.int32), HIGHEST_LEVEL),
    )


def observe(state: State) -> Bool[Array, "... 10 10 4"]:
    """Player, enemies, where things came from, gold."""
    thing = jnp.where(inside(state.thing), state.thing, 2 * EMPTY)
    behind = thing - sign(state.right)

    def layer(shown: Bool[Array, "*batch 8"] | bool, column: Int32[Array, "*batch 8"]) -> Bool[Array, "*batch 10 10"]:
        # Row 0 and row 9 hold nothing.
        ends = [(0, 0)] * (column.ndim - 1) + [(1, 1)]
        return columns(jnp.pad(jnp.where(shown, column, 2 * EMPTY), ends, constant_values=2 * EMPTY))

    return board(cells(state.y, state.x), layer(~state.gold, thing), layer(True, behind), layer(state.gold, thing))


ASTERIX = Game("Asterix", 4, (NOOP, LEFT, UP, RIGHT, DOWN), reset, no_noise, observe, play, numbers=3)
