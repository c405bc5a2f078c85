"""CartPole-v1: balance a pole on a cart by pushing left or right (Barto, Sutton and Anderson, 1983), as in Gymnasium 1.4.0.

State and observation: ``float32[..., 4]``: cart position (m), its velocity (m/s), pole angle (rad), its velocity (rad/s). Explicit Euler,
0.02 s a step. It ends beyond 2.4 m or 12 degrees. Every step, the last one too, is worth 1; with ``sutton_barto_reward`` 0 and the last -1.
"""

import math

import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from jaxtyping import Array, Bool, Float, Int32

from thorndike.environments.native.randomness import draw_words, no_noise, uniforms
from thorndike.environments.native.vectorize import Dynamics

GRAVITY = 9.8
POLE_MASS = 0.1
TOTAL_MASS = 1.1
HALF_LENGTH = 0.5
POLE_MOMENT = POLE_MASS * HALF_LENGTH
FORCE = 10.0
SECONDS = 0.02
MAX_POSITION = 2.4
MAX_ANGLE = 12 * 2 * math.pi / 360

State = Float[Array, "*batch 4"]


def cartpole(*, sutton_barto_reward: bool = False) -> Dynamics:
    """CartPole-v1 with Gymnasium's setting: the reward of the book instead of 1 a step."""
    high = np.array([MAX_POSITION * 2, np.inf, MAX_ANGLE * 2, np.inf], np.float32)

    def step(state: State, action: Int32[Array, "*batch"], noise: tuple[()]) -> tuple[State, Float[Array, "*batch"], Bool[Array, "*batch"]]:
        del noise
        after = integrate(state, action)
        terminated = (jnp.abs(after[..., 0]) > MAX_POSITION) | (jnp.abs(after[..., 2]) > MAX_ANGLE)
        reward = -terminated.astype(jnp.float32) if sutton_barto_reward else jnp.ones_like(terminated, jnp.float32)
        return after, reward, terminated

    return Dynamics(
        reset=lambda words: uniforms(words, 4, -0.05, 0.05),
        observe=lambda state: state,
        step=step,
        draw_reset=draw_words,
        draw_step=no_noise,
        observation_space=spaces.Box(-high, high, dtype=np.float32),
        action_space=spaces.Discrete(2),
        id="CartPole-v1",
        max_episode_steps=500,
    )


def integrate(state: State, action: Int32[Array, "*batch"]) -> State:
    """0.02 s later (https://coneural.org/florian/papers/05_cart_pole.pdf, equations 23 and 24 without friction)."""
    velocity, angle, spin = state[..., 1], state[..., 2], state[..., 3]
    force = jnp.where(action == 1, jnp.float32(FORCE), jnp.float32(-FORCE))
    cosine, sine = jnp.cos(angle), jnp.sin(angle)
    push = (force + POLE_MOMENT * jnp.square(spin) * sine) / TOTAL_MASS
    spin_rate = (GRAVITY * sine - cosine * push) / (HALF_LENGTH * (4.0 / 3.0 - POLE_MASS * jnp.square(cosine) / TOTAL_MASS))
    acceleration = push - POLE_MOMENT * spin_rate * cosine / TOTAL_MASS
    return state + SECONDS * jnp.stack([velocity, acceleration, spin, spin_rate], axis=-1)
