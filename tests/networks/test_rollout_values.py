"""Values of a rollout, looked at once where the next observation is the successor."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces

from thorndike.networks.heads import actor_critic
from thorndike.networks.network import apply_rollout, rollout_values
from thorndike.types import Rollout, Step

LENGTH, ENVS = 24, 3
NETWORK = actor_critic(spaces.Box(-9.0, 9.0, (2,)), 2, 0, (8,), "tanh")


@pytest.fixture(scope="module")
def params():
    return NETWORK.init(jax.random.key(0), jnp.zeros((1, 2)))


def rollout(truncations: float, terminations: float) -> Rollout:
    """Observations follow each other; after an end another episode begins, elsewhere than at the true successor."""
    rng = np.random.default_rng(1)
    truncated, terminated = (rng.uniform(size=(LENGTH, ENVS)) < share for share in (truncations, terminations))
    next_obs = rng.normal(size=(LENGTH, ENVS, 2)).astype(np.float32)
    fresh = rng.normal(size=(LENGTH, ENVS, 2)).astype(np.float32)
    after = np.where((truncated | terminated)[..., None], fresh, next_obs)
    obs = np.concatenate([rng.normal(size=(1, ENVS, 2)).astype(np.float32), after[:-1]])
    zero = jnp.zeros((LENGTH, ENVS))
    step = Step(
        *map(jnp.asarray, (after, next_obs)), zero, zero, jnp.asarray(terminated), jnp.asarray(truncated), jnp.ones_like(zero, bool)
    )
    return Rollout(jnp.asarray(obs), zero, {}, step, ())


@pytest.mark.parametrize(("truncations", "terminations"), [(0.0, 0.2), (0.05, 0.1), (0.9, 0.0), (1.0, 0.5)])
def test_values_of_successors_are_those_of_looking_at_all_of_them(params, truncations, terminations):
    played = rollout(truncations, terminations)
    (_, value), (_, next_value) = apply_rollout(NETWORK, params, played)
    found, found_next = jax.jit(lambda played: rollout_values(NETWORK, params, played))(played)
    goes_on = ~np.asarray(played.step.terminated)
    np.testing.assert_allclose(found, value, atol=1e-6)
    np.testing.assert_allclose(np.asarray(found_next)[goes_on], np.asarray(next_value)[goes_on], atol=1e-6)
