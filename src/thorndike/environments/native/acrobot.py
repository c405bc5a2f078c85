"""Acrobot-v1: swing the lower of two links above a line by torque on the joint between them (Sutton, 1996), as in Gymnasium 1.4.0.

State ``float32[..., 4]``: angle of the first link from straight down, angle of the second relative to the first (rad, within pi), their
velocities (rad/s, bounded by 4 pi and 9 pi). Observation ``float32[..., 6]``: cosine and sine of both angles, the velocities. One
Runge-Kutta step of 0.2 s with the book's equations. Every step costs 1, the one that reaches the line nothing.
"""

import math
from typing import TypeAlias

import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from jaxtyping import Array, Bool, Float, Int32

from thorndike.environments.native.randomness import draw_words, no_noise, uniforms
from thorndike.environments.native.vectorize import Dynamics

GRAVITY = 9.8
SECONDS = 0.2
CENTRE = 0.5
MAX_SPIN_1 = 4 * math.pi
MAX_SPIN_2 = 9 * math.pi
FULL_TURN = 2 * math.pi

State: TypeAlias = Float[Array, "*batch 4"]
Parts: TypeAlias = tuple[Array, ...]
"""The four numbers of a state, each ``[...]``."""


def acrobot() -> Dynamics:
    """Acrobot-v1. All masses, lengths and moments of inertia are 1, the centres of mass halfway."""
    high = np.array([1.0, 1.0, 1.0, 1.0, MAX_SPIN_1, MAX_SPIN_2], np.float32)
    return Dynamics(
        reset=lambda words: uniforms(words, 4, -0.1, 0.1),
        observe=observe,
        step=step,
        draw_reset=draw_words,
        draw_step=no_noise,
        observation_space=spaces.Box(-high, high, dtype=np.float32),
        action_space=spaces.Discrete(3),
        id="Acrobot-v1",
        max_episode_steps=500,
    )


def observe(state: State) -> Float[Array, "*batch 6"]:
    """Angles as cosine and sine, then the velocities."""
    first, second = state[..., 0], state[..., 1]
    return jnp.stack([jnp.cos(first), jnp.sin(first), jnp.cos(second), jnp.sin(second), state[..., 2], state[..., 3]], axis=-1)


def step(state: State, action: Int32[Array, "*batch"], noise: tuple[()]) -> tuple[State, Float[Array, "*batch"], Bool[Array, "*batch"]]:
    """0.2 s of torque -1, 0 or 1."""
    del noise
    torque = action.astype(jnp.float32) - 1
    first, second, spin_1, spin_2 = runge_kutta((state[..., 0], state[..., 1], state[..., 2], state[..., 3]), torque)
    first, second = wrap(first), wrap(second)
    spin_1 = jnp.clip(spin_1, -MAX_SPIN_1, MAX_SPIN_1)
    spin_2 = jnp.clip(spin_2, -MAX_SPIN_2, MAX_SPIN_2)
    terminated = -jnp.cos(first) - jnp.cos(second + first) > 1
    return jnp.stack([first, second, spin_1, spin_2], axis=-1), terminated.astype(jnp.float32) - 1, terminated


def runge_kutta(state: Parts, torque: Float[Array, "*batch"]) -> Parts:
    """One step of the classic fourth-order method over 0.2 s."""

    def along(slope: Parts, seconds: float) -> Parts:
        return tuple(value + seconds * rate for value, rate in zip(state, slope, strict=True))

    slope_1 = derivative(state, torque)
    slope_2 = derivative(along(slope_1, SECONDS / 2), torque)
    slope_3 = derivative(along(slope_2, SECONDS / 2), torque)
    slope_4 = derivative(along(slope_3, SECONDS), torque)
    mean = tuple(a + 2 * b + 2 * c + d for a, b, c, d in zip(slope_1, slope_2, slope_3, slope_4, strict=True))
    return along(mean, SECONDS / 6)


def derivative(state: Parts, torque: Float[Array, "*batch"]) -> Parts:
    """Rates of change (Sutton and Barto, 1998, section 11.3: what Gymnasium calls the ``book`` variant)."""
    first, second, spin_1, spin_2 = state
    cosine, sine = jnp.cos(second), jnp.sin(second)
    inertia_1 = CENTRE**2 + (1 + CENTRE**2 + 2 * CENTRE * cosine) + 2
    inertia_2 = CENTRE**2 + CENTRE * cosine + 1
    # cos(angle - pi/2), as Gymnasium writes it, is sin(angle).
    weight_2 = CENTRE * GRAVITY * jnp.sin(first + second)
    weight_1 = -CENTRE * sine * spin_2 * (spin_2 + 2 * spin_1) + (CENTRE + 1) * GRAVITY * jnp.sin(first) + weight_2
    ratio = inertia_2 / inertia_1
    rate_2 = (torque + ratio * weight_1 - CENTRE * jnp.square(spin_1) * sine - weight_2) / (CENTRE**2 + 1 - inertia_2 * ratio)
    rate_1 = -(inertia_2 * rate_2 + weight_1) / inertia_1
    return spin_1, spin_2, rate_1, rate_2


def wrap(angle: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """The same angle within pi; pi and -pi stay as they are, because rounding is to even."""
    return angle - FULL_TURN * jnp.round(angle / FULL_TURN)
