"""Pendulum-v1: swing a pendulum up by a torque too weak to lift it, as in Gymnasium 1.4.0.

State ``float32[..., 2]``: angle from upright (rad), velocity (rad/s, within 8). Observation ``float32[..., 3]``: cosine, sine, velocity.
The reward is that of the state *before* the step. It never terminates. Gymnasium lets the angle grow; here it is kept within pi, which
changes nothing it shows and keeps float32 exact to the last step.
"""

import math
from typing import TypeAlias

import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from jaxtyping import Array, Bool, Float, UInt32

from thorndike.environments.native.randomness import draw_words, no_noise, uniforms
from thorndike.environments.native.vectorize import Dynamics

MAX_SPEED = 8.0
MAX_TORQUE = 2.0
SECONDS = 0.05
FULL_TURN = 2 * math.pi

State: TypeAlias = Float[Array, "*batch 2"]


def pendulum(*, g: float = 10.0) -> Dynamics:
    """Pendulum-v1 with Gymnasium's setting: the acceleration of gravity in m/s^2. Mass and length are 1."""
    high = np.array([1.0, 1.0, MAX_SPEED], np.float32)

    def step(
        state: State, action: Float[Array, "*batch 1"], noise: tuple[()]
    ) -> tuple[State, Float[Array, "*batch"], Bool[Array, "*batch"]]:
        del noise
        angle, speed = wrap(state[..., 0]), state[..., 1]
        torque = jnp.clip(action[..., 0], -MAX_TORQUE, MAX_TORQUE)
        cost = jnp.square(angle) + 0.1 * jnp.square(speed) + 0.001 * jnp.square(torque)
        faster = jnp.clip(speed + (1.5 * g * jnp.sin(angle) + 3 * torque) * SECONDS, -MAX_SPEED, MAX_SPEED)
        return jnp.stack([wrap(angle + faster * SECONDS), faster], axis=-1), -cost, jnp.zeros_like(cost, jnp.bool_)

    return Dynamics(
        reset=start,
        observe=observe,
        step=step,
        draw_reset=draw_words,
        draw_step=no_noise,
        observation_space=spaces.Box(-high, high, dtype=np.float32),
        action_space=spaces.Box(-MAX_TORQUE, MAX_TORQUE, (1,), np.float32),
        id="Pendulum-v1",
        max_episode_steps=200,
    )


def start(words: UInt32[Array, "*batch"]) -> State:
    """Any angle, a velocity within 1."""
    numbers = uniforms(words, 2, -1.0, 1.0)
    return jnp.stack([math.pi * numbers[..., 0], numbers[..., 1]], axis=-1)


def observe(state: State) -> Float[Array, "*batch 3"]:
    """Cosine and sine of the angle, and the velocity."""
    return jnp.stack([jnp.cos(state[..., 0]), jnp.sin(state[..., 0]), state[..., 1]], axis=-1)


def wrap(angle: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """The same angle within pi; exact for an angle that already is."""
    return angle - FULL_TURN * jnp.round(angle / FULL_TURN)
