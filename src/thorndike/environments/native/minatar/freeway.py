"""MinAtar Freeway: cross eight lanes of cars, again and again, for 2,501 steps (Young and Tian, 2019; rules of minatar 1.0.15).

Each crossing is worth 1 and gives every car a new speed; a car sends the player back to the start. The end is reported as ``terminated``,
as the package does, though it is a time limit. Channels: player, cars, and where a car came from, one channel a speed (of five).
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int32, UInt32

from thorndike.environments.native.minatar.game import (
    DOWN,
    LAST,
    NOOP,
    UP,
    Game,
    board,
    cells,
    columns,
    dynamics,
    move,
    places,
    sign,
    whole,
)
from thorndike.environments.native.randomness import draw_words, uniforms
from thorndike.environments.native.vectorize import Dynamics

LANES = 8
"""Rows 1 to 8."""
SLOWEST = 5
PLAYER_COLUMN = 4
PLAYER_INTERVAL = 3
TIME_LIMIT = 2500


class State(NamedTuple):
    """The player's row, one car a lane, and clocks that count down."""

    y: Int32[Array, "*batch"]
    car: Int32[Array, "*batch 8"]
    right: Bool[Array, "*batch 8"]
    interval: Int32[Array, "*batch 8"]
    """Steps a car waits between two moves, 1 to 5."""
    car_timer: Int32[Array, "*batch 8"]
    move_timer: Int32[Array, "*batch"]
    time_left: Int32[Array, "*batch"]


def freeway(*, sticky_action_prob: float = 0.1, difficulty_ramping: bool = True) -> Dynamics:
    """MinAtar/Freeway-v0: six actions. The game never grows harder, so `difficulty_ramping` changes nothing."""
    del difficulty_ramping
    return dynamics(FREEWAY, 0, sticky_action_prob)


def freeway_minimal(*, sticky_action_prob: float = 0.1, difficulty_ramping: bool = True) -> Dynamics:
    """MinAtar/Freeway-v1: stay, up, down."""
    del difficulty_ramping
    return dynamics(FREEWAY, 1, sticky_action_prob)


def speeds(numbers: Float[Array, "*batch 8"]) -> tuple[Bool[Array, "*batch 8"], Int32[Array, "*batch 8"]]:
    """Whether each car goes to the right, and its interval: ten possibilities, equally likely."""
    drawn = whole(numbers, 2 * SLOWEST)
    right = drawn >= SLOWEST
    return right, 1 + drawn - jnp.where(right, SLOWEST, 0)


def reset(words: UInt32[Array, "*batch"]) -> State:
    """The player at the bottom, all cars at the left."""
    right, interval = speeds(uniforms(words, LANES, 0.0, 1.0))
    start = jnp.full(words.shape, LAST, jnp.int32)
    return State(
        start, jnp.zeros_like(interval), right, interval, interval, jnp.full_like(start, PLAYER_INTERVAL), jnp.full_like(start, TIME_LIMIT)
    )


def play(
    state: State, action: Int32[Array, "*batch"], numbers: Float[Array, "*batch 8"]
) -> tuple[State, Float[Array, "*batch"], Bool[Array, "*batch"]]:
    """One step: the player, who moves every third step at most, then the cars."""
    ready = state.move_timer == 0
    up, down = ready & (action == UP), ready & (action == DOWN)
    move_timer = jnp.where(up | down, PLAYER_INTERVAL, state.move_timer)
    y = move(state.y, down, up)
    crossed = y == 0
    y = jnp.where(crossed, LAST, y)
    new_right, new_interval = speeds(numbers)
    right = jnp.where(crossed[..., None], new_right, state.right)
    interval = jnp.where(crossed[..., None], new_interval, state.interval)
    timer = jnp.where(crossed[..., None], new_interval, state.car_timer)
    moving = timer == 0
    ahead = state.car + jnp.where(moving, sign(right), 0)
    car = jnp.where(ahead < 0, LAST, jnp.where(ahead > LAST, 0, ahead))
    # A car hits where it was and where it comes to.
    in_lane = (y - 1)[..., None] == places(y, LANES)
    hit = jnp.any(in_lane & ((state.car == PLAYER_COLUMN) | (car == PLAYER_COLUMN)), axis=-1)
    after = State(
        y=jnp.where(hit, LAST, y),
        car=car,
        right=right,
        interval=interval,
        car_timer=jnp.where(moving, interval, timer - 1),
        move_timer=jnp.maximum(move_timer - 1, 0),
        time_left=state.time_left - 1,
    )
    return after, crossed.astype(jnp.float32), after.time_left < 0


def observe(state: State) -> Bool[Array, "... 10 10 7"]:
    """Player, cars, and where cars came from for each of the five speeds."""
    back = state.car - sign(state.right)
    behind = jnp.where(back < 0, LAST, jnp.where(back > LAST, 0, back))
    ends = [(0, 0)] * (state.car.ndim - 1) + [(1, 1)]
    # Row 0 and row 9 have no car: column -1 is none.
    trails = [columns(jnp.pad(jnp.where(state.interval == each, behind, -1), ends, constant_values=-1)) for each in range(1, SLOWEST + 1)]
    player = cells(state.y, jnp.full_like(state.y, PLAYER_COLUMN))
    return board(player, columns(jnp.pad(state.car, ends, constant_values=-1)), *trails)


FREEWAY = Game("Freeway", 7, (NOOP, UP, DOWN), reset, draw_words, observe, play, numbers=LANES)
