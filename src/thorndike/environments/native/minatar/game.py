"""What the five MinAtar games share: six actions, sticky actions, a board of 10 x 10 cells with one channel a kind of thing.

Young and Tian, 2019, "MinAtar: An Atari-Inspired Testbed", arXiv:1903.03176; the rules are those of the package minatar 1.0.15, written
anew and checked against it step by step (tests/environments/test_minatar_parity.py). One difference: an episode starts with no action to
repeat; the package carries the last action of the episode before into the next one.

States are small on purpose: a number a thing, or a word of bits a row of the board. The board is drawn from them by comparing places, for
a scatter would be slow.
"""

import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from jaxtyping import Array, Bool, Float, Int32, Key, PyTree, UInt32

from thorndike.environments.native.randomness import draw_words, uniforms
from thorndike.environments.native.vectorize import Dynamics
from thorndike.errors import UserError
from thorndike.types import Noise

SIZE = 10
LAST = SIZE - 1
NOOP, LEFT, UP, RIGHT, DOWN, FIRE = range(6)
ALL_ACTIONS = (NOOP, LEFT, UP, RIGHT, DOWN, FIRE)
EMPTY = -1
"""The column of what is not there; any column off the board means the same."""


class Game(NamedTuple):
    """One game's rules; arrays may have leading batch dimensions ``[...]``."""

    name: str
    channels: int
    minimal_actions: tuple[int, ...]
    """The actions that do something, of the six."""
    reset: Callable[[Noise], PyTree]
    draw_reset: Callable[[Key[Array, ""], tuple[int, ...]], Noise]
    observe: Callable[[PyTree], Bool[Array, "... 10 10 C"]]
    play: Callable[[PyTree, Int32[Array, "*batch"], Float[Array, "*batch N"]], tuple[PyTree, Float[Array, "*batch"], Bool[Array, "*batch"]]]
    """state, action (of the six), ``numbers`` uniform numbers in [0, 1) -> successor, reward, terminated."""
    numbers: int


class Played(NamedTuple):
    """The state of a game, and the action that may be repeated."""

    game: PyTree
    last_action: Int32[Array, "*batch"]


def dynamics(game: Game, version: int, sticky_action_prob: float) -> Dynamics:
    """The environment ``MinAtar/<name>-v<version>``: version 0 has all six actions, 1 those that do something.

    With probability `sticky_action_prob` a step repeats the action before. Raises UserError if that is not a number from 0 to 1.
    """
    id = f"MinAtar/{game.name}-v{version}"
    if not isinstance(sticky_action_prob, int | float) or not 0 <= sticky_action_prob <= 1:
        raise UserError(f"sticky_action_prob of {id} must be a number from 0 to 1, not {sticky_action_prob!r}")
    actions = ALL_ACTIONS if version == 0 else game.minimal_actions

    def reset(noise: Noise) -> Played:
        shape = () if isinstance(noise, tuple) else noise.shape
        return Played(game.reset(noise), jnp.full(shape, NOOP, jnp.int32))

    def step(state: Played, action: Int32[Array, "*batch"], words: UInt32[Array, "*batch"]) -> tuple[Played, Array, Array]:
        numbers = uniforms(words, 1 + game.numbers, 0.0, 1.0)
        played = jnp.where(numbers[..., 0] < sticky_action_prob, state.last_action, of_the_six(action, actions))
        after, reward, terminated = game.play(state.game, played, numbers[..., 1:])
        return Played(after, played), reward, terminated

    return Dynamics(
        reset=reset,
        observe=lambda state: game.observe(state.game),
        step=step,
        draw_reset=game.draw_reset,
        draw_step=draw_words,
        observation_space=spaces.Box(0.0, 1.0, (SIZE, SIZE, game.channels), np.bool_),
        action_space=spaces.Discrete(len(actions)),
        id=id,
    )


def of_the_six(action: Int32[Array, "*batch"], actions: Sequence[int]) -> Int32[Array, "*batch"]:
    """The action that a number of the set `actions` stands for."""
    played = action
    for number, meant in enumerate(actions):
        if number != meant:
            played = jnp.where(action == number, meant, played)
    return played


def move(place: Int32[Array, "*batch"], forth: Bool[Array, "*batch"], back: Bool[Array, "*batch"], low: int = 0, high: int = LAST) -> Array:
    """One cell forth or back, at most to the ends."""
    return jnp.clip(place + forth.astype(jnp.int32) - back.astype(jnp.int32), low, high)


def sign(forth: Bool[Array, "*batch"]) -> Int32[Array, "*batch"]:
    """1 where true, -1 elsewhere."""
    return jnp.where(forth, jnp.int32(1), jnp.int32(-1))


def whole(number: Float[Array, "*batch"], count: int | Int32[Array, "*batch"]) -> Int32[Array, "*batch"]:
    """0 to ``count - 1`` from a number in [0, 1) of 24 bits; float32 never rounds the product up to `count`."""
    return (number * count).astype(jnp.int32)


def inside(column: Int32[Array, "*batch"]) -> Bool[Array, "*batch"]:
    """Whether a column is one of the board's."""
    return (column >= 0) & (column <= LAST)


def places(like: Array, count: int) -> Int32[Array, "... count"]:
    """0 to ``count - 1`` on one more axis than `like` has."""
    return jnp.arange(count, dtype=jnp.int32).reshape((1,) * like.ndim + (count,))


def cells(row: Int32[Array, "*batch"], column: Int32[Array, "*batch"]) -> Bool[Array, "*batch 10 10"]:
    """A board that is true at one cell, or nowhere if that lies off it."""
    return (row[..., None] == places(row, SIZE))[..., :, None] & (column[..., None] == places(column, SIZE))[..., None, :]


def columns(column: Int32[Array, "*batch 10"]) -> Bool[Array, "*batch 10 10"]:
    """A board that is true at one column of each row, or nowhere in it if that lies off the board."""
    return column[..., None] == places(column, SIZE)


def bits(words: Int32[Array, "*batch 10"], first: int = 0) -> Bool[Array, "*batch 10 10"]:
    """A board from one word a row: bit ``first + column``."""
    return ((words[..., None] >> (places(words, SIZE) + first)) & 1) == 1


def board(*layers: Bool[Array, "*batch 10 10"]) -> Bool[Array, "*batch 10 10 C"]:
    """The observation: one channel a layer."""
    words = functools.reduce(jnp.bitwise_or, [layer.astype(jnp.int32) << number for number, layer in enumerate(layers)])
    # Else XLA works every layer out again for each channel.
    words = jax.lax.optimization_barrier(words)
    return ((words[..., None] >> places(words, len(layers))) & 1) == 1
