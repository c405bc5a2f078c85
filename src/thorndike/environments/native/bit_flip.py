"""BitFlip-v0: turn a row of bits into another one, a bit a step, for a reward that says nothing until it is done.

Andrychowicz et al. 2017, "Hindsight Experience Replay" (arXiv:1707.01495), section 3.1: a random start and a random goal, reward -1 a
step and 0 at the goal, where the episode ends; ``bits`` steps at most. Without hindsight, learning fails from about 13 bits on: no start
in ``2^bits`` ever meets its goal by chance.

State ``float32[..., 2, bits]``: the bits and the goal, each 0 or 1. Observation: the Dict of Gymnasium-robotics' goal environments,
``observation`` and ``achieved_goal`` (both the bits) and ``desired_goal``. Action ``i`` flips bit ``i``.
"""

from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from jaxtyping import Array, Bool, Float, Int32, UInt32

from thorndike.environments.native.randomness import draw_words, no_noise, uniforms
from thorndike.environments.native.vectorize import Dynamics
from thorndike.errors import UserError
from thorndike.types import Goal, Observation

Bits: TypeAlias = Float[Array, "*batch bits"]
State: TypeAlias = Float[Array, "*batch 2 bits"]


def bit_flip(*, bits: int = 8) -> Dynamics:
    """BitFlip-v0 with ``bits`` bits. Raises ``UserError`` for fewer than one."""
    if bits < 1:
        raise UserError(f"BitFlip-v0: bits is at least 1, not {bits}")
    row = spaces.Box(0.0, 1.0, (bits,), np.float32)

    def start(words: UInt32[Array, "*batch"]) -> State:
        coins = uniforms(words, 2 * bits, 0.0, 1.0) < 0.5
        return coins.astype(jnp.float32).reshape((*words.shape, 2, bits))

    def step(state: State, action: Int32[Array, "*batch"], noise: tuple[()]) -> tuple[State, Float[Array, "*batch"], Bool[Array, "*batch"]]:
        del noise
        flipped = jax.lax.broadcasted_iota(jnp.int32, (*action.shape, bits), action.ndim) == action[..., None]
        after = jnp.where(flipped, 1.0 - state[..., 0, :], state[..., 0, :])
        goal = state[..., 1, :]
        return jnp.stack([after, goal], axis=-2), reward(after, goal), reached(after, goal)

    return Dynamics(
        reset=start,
        observe=observe,
        step=step,
        draw_reset=draw_words,
        draw_step=no_noise,
        observation_space=spaces.Dict({"observation": row, "achieved_goal": row, "desired_goal": row}),
        action_space=spaces.Discrete(bits),
        id="BitFlip-v0",
        max_episode_steps=bits,
        goal=Goal(reward, reached),
    )


def observe(state: State) -> Observation:
    """The bits, twice, and the goal."""
    return {"observation": state[..., 0, :], "achieved_goal": state[..., 0, :], "desired_goal": state[..., 1, :]}


def reached(achieved: Bits, desired: Bits) -> Bool[Array, "*batch"]:
    """Whether all bits are as desired."""
    return jnp.all(achieved == desired, axis=-1)


def reward(achieved: Bits, desired: Bits) -> Float[Array, "*batch"]:
    """0 at the goal, -1 elsewhere."""
    return reached(achieved, desired).astype(jnp.float32) - 1.0
