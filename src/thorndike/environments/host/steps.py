"""A Step of NumPy arrays."""

from typing import cast

import numpy as np
from jaxtyping import Array

from thorndike.types import Observation, Step


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
