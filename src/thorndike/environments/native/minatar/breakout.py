"""MinAtar Breakout: bounce a ball off a paddle to break three rows of bricks (Young and Tian, 2019; rules of minatar 1.0.15).

Every brick is worth 1; when none is left and the ball comes down, three new rows are there. It ends when the ball is missed. Nothing is
random but the side from which the ball starts. Channels: paddle, ball, where the ball was, bricks.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int32, UInt32

from thorndike.environments.native.minatar.game import LAST, LEFT, NOOP, RIGHT, SIZE, Game, bits, board, cells, dynamics, move, places, sign
from thorndike.environments.native.randomness import draw_words, uniforms
from thorndike.environments.native.vectorize import Dynamics

FIRST_ROW, LAST_ROW = 1, 3
ALL_BRICKS = 2 ** (3 * SIZE) - 1


class State(NamedTuple):
    """Paddle, ball and bricks."""

    paddle: Int32[Array, "*batch"]
    x: Int32[Array, "*batch"]
    y: Int32[Array, "*batch"]
    last_x: Int32[Array, "*batch"]
    last_y: Int32[Array, "*batch"]
    right: Bool[Array, "*batch"]
    down: Bool[Array, "*batch"]
    in_brick: Bool[Array, "*batch"]
    """Whether the ball met a brick in the step before: it breaks no second one at once."""
    bricks: Int32[Array, "*batch"]
    """Bit ``10 (row - 1) + column``."""


def breakout(*, sticky_action_prob: float = 0.1, difficulty_ramping: bool = True) -> Dynamics:
    """MinAtar/Breakout-v0: six actions. The game never grows harder, so `difficulty_ramping` changes nothing."""
    del difficulty_ramping
    return dynamics(BREAKOUT, 0, sticky_action_prob)


def breakout_minimal(*, sticky_action_prob: float = 0.1, difficulty_ramping: bool = True) -> Dynamics:
    """MinAtar/Breakout-v1: stay, left, right."""
    del difficulty_ramping
    return dynamics(BREAKOUT, 1, sticky_action_prob)


def reset(words: UInt32[Array, "*batch"]) -> State:
    """The ball in the upper left or right corner below the bricks."""
    right = uniforms(words, 1, 0.0, 1.0)[..., 0] < 0.5
    x = jnp.where(right, jnp.int32(0), jnp.int32(LAST))
    y, no = jnp.full_like(x, LAST_ROW), jnp.zeros_like(right)
    return State(jnp.full_like(x, 4), x, y, x, y, right, ~no, no, jnp.full_like(x, ALL_BRICKS))


def play(
    state: State, action: Int32[Array, "*batch"], numbers: Float[Array, "*batch N"]
) -> tuple[State, Float[Array, "*batch"], Bool[Array, "*batch"]]:
    """One step: the paddle, then the ball, which moves along diagonals."""
    del numbers
    paddle = move(state.paddle, action == RIGHT, action == LEFT)
    x, y = state.x + sign(state.right), state.y + sign(state.down)
    wall = (x < 0) | (x > LAST)
    x = jnp.clip(x, 0, LAST)
    ceiling, bottom = y < 0, y == LAST
    brick = jnp.where((y >= FIRST_ROW) & (y <= LAST_ROW), jnp.int32(1) << jnp.clip(SIZE * (y - FIRST_ROW) + x, 0, 3 * SIZE - 1), 0)
    in_brick = (state.bricks & brick) != 0
    broken = in_brick & ~state.in_brick
    bricks = jnp.where(broken, state.bricks & ~brick, state.bricks)
    caught = bottom & (state.x == paddle)
    # With its corner the paddle sends the ball back where it came from.
    cornered = bottom & ~caught & (x == paddle)
    bounced = broken | caught | cornered
    after = State(
        paddle=paddle,
        x=x,
        y=jnp.where(ceiling, 0, jnp.where(bounced, state.y, y)),
        last_x=state.x,
        last_y=state.y,
        right=state.right ^ wall ^ cornered,
        down=state.down ^ (ceiling | bounced),
        in_brick=in_brick,
        bricks=jnp.where(bottom & (bricks == 0), ALL_BRICKS, bricks),
    )
    return after, broken.astype(jnp.float32), bottom & ~caught & ~cornered


def observe(state: State) -> Bool[Array, "... 10 10 4"]:
    """Paddle, ball, where the ball was, bricks."""
    row = places(state.bricks, SIZE)
    words = jnp.where(
        (row >= FIRST_ROW) & (row <= LAST_ROW), state.bricks[..., None] >> jnp.clip(SIZE * (row - FIRST_ROW), 0, 2 * SIZE), jnp.int32(0)
    )
    return board(
        cells(jnp.full_like(state.paddle, LAST), state.paddle), cells(state.y, state.x), cells(state.last_y, state.last_x), bits(words)
    )


BREAKOUT = Game("Breakout", 4, (NOOP, LEFT, RIGHT), reset, draw_words, observe, play, numbers=0)
