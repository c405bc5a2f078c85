"""DeepSea-v0, compiled: its rules are in ``environments/deep_sea.py``. State: the number of the cell, ``int32[...]``; N * N at the end."""

import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from jaxtyping import Array, Bool, Float, Int32

from thorndike.environments.deep_sea import Observed, observation_space, right_actions
from thorndike.environments.native.randomness import no_noise
from thorndike.environments.native.vectorize import Dynamics
from thorndike.types import Observation


def deep_sea(
    *,
    size: int = 10,
    randomize_actions: bool = True,
    mapping_seed: int = 42,
    unscaled_move_cost: float = 0.01,
    observation: Observed = "one_hot",
) -> Dynamics:
    """DeepSea-v0 with the settings of ``DeepSeaEnv``. Raises UserError for a size below 2 or another kind of observation."""
    space = observation_space(size, observation)
    cells, cost = size * size, np.float32(unscaled_move_cost / size)
    # One more for the state after the end, which no step starts from.
    right = jnp.asarray(np.append(right_actions(size, randomize_actions, mapping_seed).ravel(), 0), jnp.int32)

    def observe(state: Int32[Array, "*batch"]) -> Observation:
        if observation == "index":
            return state
        grid = jnp.arange(cells, dtype=jnp.int32).reshape((1,) * state.ndim + (size, size))
        return (state[..., None, None] == grid).astype(jnp.float32)

    def step(
        state: Int32[Array, "*batch"], action: Int32[Array, "*batch"], noise: tuple[()]
    ) -> tuple[Int32[Array, "*batch"], Float[Array, "*batch"], Bool[Array, "*batch"]]:
        del noise
        row, column = state // size, state % size
        to_the_right = action == right[state]
        reward = jnp.where(to_the_right, (column == size - 1).astype(jnp.float32) - cost, 0.0)
        column = jnp.clip(column + jnp.where(to_the_right, 1, -1), 0, size - 1)
        after = jnp.minimum((row + 1) * size + column, cells)
        return after, reward, after >= cells

    return Dynamics(
        reset=lambda noise: jnp.zeros((), jnp.int32),
        observe=observe,
        step=step,
        draw_reset=no_noise,
        draw_step=no_noise,
        observation_space=space,
        action_space=spaces.Discrete(2),
        id="DeepSea-v0",
    )
