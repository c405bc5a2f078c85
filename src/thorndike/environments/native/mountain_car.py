"""MountainCar-v0 and MountainCarContinuous-v0: rock a weak car out of a valley (Moore, 1990), as in Gymnasium 1.4.0.

State and observation ``float32[..., 2]``: position within [-1.2, 0.6], velocity within 0.07. The left wall stops the car. The discrete
task costs 1 a step and ends at 0.5; the continuous one ends at 0.45 with 100 and costs 0.1 x action^2 (of the action as given, not as
clipped).
"""

from typing import TypeAlias

import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from jaxtyping import Array, Bool, Float, Int32, UInt32

from thorndike.environments.native.randomness import draw_words, no_noise, unit_interval
from thorndike.environments.native.vectorize import Dynamics

MIN_POSITION = -1.2
MAX_POSITION = 0.6
MAX_SPEED = 0.07
SLOPE = 0.0025
FORCE = 0.001
POWER = 0.0015
GOAL = 0.5
GOAL_CONTINUOUS = 0.45

State: TypeAlias = Float[Array, "*batch 2"]
Outcome: TypeAlias = tuple[State, Float[Array, "*batch"], Bool[Array, "*batch"]]


def mountain_car(*, goal_velocity: float = 0.0) -> Dynamics:
    """MountainCar-v0 (left, nothing, right) with Gymnasium's setting: the least velocity at the goal."""

    def step(state: State, action: Int32[Array, "*batch"], noise: tuple[()]) -> Outcome:
        del noise
        after = roll(state, (action.astype(jnp.float32) - 1) * FORCE)
        terminated = (after[..., 0] >= GOAL) & (after[..., 1] >= goal_velocity)
        return after, -jnp.ones_like(after[..., 0]), terminated

    return Dynamics(
        reset=start,
        observe=lambda state: state,
        step=step,
        draw_reset=draw_words,
        draw_step=no_noise,
        observation_space=_observation_space(),
        action_space=spaces.Discrete(3),
        id="MountainCar-v0",
        max_episode_steps=200,
    )


def mountain_car_continuous(*, goal_velocity: float = 0.0) -> Dynamics:
    """MountainCarContinuous-v0 (a force within 1) with Gymnasium's setting: the least velocity at the goal."""

    def step(state: State, action: Float[Array, "*batch 1"], noise: tuple[()]) -> Outcome:
        del noise
        force = action[..., 0]
        after = roll(state, jnp.clip(force, -1, 1) * POWER)
        terminated = (after[..., 0] >= GOAL_CONTINUOUS) & (after[..., 1] >= goal_velocity)
        return after, 100 * terminated.astype(jnp.float32) - 0.1 * jnp.square(force), terminated

    return Dynamics(
        reset=start,
        observe=lambda state: state,
        step=step,
        draw_reset=draw_words,
        draw_step=no_noise,
        observation_space=_observation_space(),
        action_space=spaces.Box(-1.0, 1.0, (1,), np.float32),
        id="MountainCarContinuous-v0",
        max_episode_steps=999,
    )


def start(words: UInt32[Array, "*batch"]) -> State:
    """At rest, uniform in [-0.6, -0.4)."""
    position = 0.2 * unit_interval(words) - 0.6
    return jnp.stack([position, jnp.zeros_like(position)], axis=-1)


def roll(state: State, push: Float[Array, "*batch"]) -> State:
    """One step of the car under ``push`` and its weight; the left wall takes its velocity."""
    position, velocity = state[..., 0], state[..., 1]
    velocity = jnp.clip(velocity + push - SLOPE * jnp.cos(3 * position), -MAX_SPEED, MAX_SPEED)
    position = jnp.clip(position + velocity, MIN_POSITION, MAX_POSITION)
    at_wall = (position == jnp.float32(MIN_POSITION)) & (velocity < 0)
    return jnp.stack([position, jnp.where(at_wall, jnp.float32(0), velocity)], axis=-1)


def _observation_space() -> spaces.Box:
    """Position and velocity."""
    return spaces.Box(np.array([MIN_POSITION, -MAX_SPEED], np.float32), np.array([MAX_POSITION, MAX_SPEED], np.float32), dtype=np.float32)
