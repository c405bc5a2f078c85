"""What every host engine gives: a Step of NumPy arrays, and the facts about its environments."""

from typing import cast

import gymnasium
import numpy as np
from jaxtyping import Array

from thorndike.types import EnvSpec, Observation, Step


def host_step(
    obs: Observation,
    next_obs: Observation,
    *,
    reward: np.ndarray,
    cost: np.ndarray,
    terminated: np.ndarray,
    truncated: np.ndarray,
    valid: np.ndarray,
) -> Step:
    """A Step whose arrays ``[B, ...]`` are on the host: the one place that says a NumPy array may stand for JAX's."""
    fields = cast("tuple[Array, Array, Array, Array, Array]", (reward, cost, terminated, truncated, valid))
    return Step(obs, next_obs, *fields)


def host_spec(
    id: str, observation: gymnasium.Space, action: gymnasium.Space, num_envs: int, max_episode_steps: int | None, engine: str
) -> EnvSpec:
    """Facts about environments outside the compiled program, whose inner state can be neither vmapped nor restored."""
    return EnvSpec(id, observation, action, num_envs, max_episode_steps, engine)
