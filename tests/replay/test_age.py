"""The age of what is replayed, against a slow walk through the ring."""

import gymnasium
import jax.numpy as jnp
import numpy as np
import pytest

from thorndike.replay.age import mean_age
from thorndike.replay.prioritized import empty_tree, set_priorities
from thorndike.replay.uniform import add, init_replay, row_shapes
from thorndike.types import EnvSpec, Rollout, Step

SPEC = EnvSpec("e", gymnasium.spaces.Box(0, 1, (1,)), gymnasium.spaces.Discrete(2), 2)


def step_of(number: int) -> Rollout:
    obs, flags = jnp.full((1, 2, 1), number, jnp.float32), jnp.zeros((1, 2), bool)
    zeros = jnp.zeros((1, 2))
    return Rollout(obs, jnp.zeros((1, 2), jnp.int32), {}, Step(obs, obs, zeros, zeros, flags, flags, ~flags), ())


@pytest.mark.parametrize("stored", [1, 3, 5, 13])
def test_ages_are_those_of_a_walk_through_the_ring(stored):
    buffer = init_replay(row_shapes(SPEC), 5, 2)
    for number in range(stored):
        buffer = add(buffer, step_of(number))
    written = np.asarray(buffer.rows["obs"])[:, 0]
    weight = np.random.default_rng(0).uniform(size=10)
    there = np.array([row // 2 < min(stored, 5) for row in range(10)])
    ages = 2 * (stored - 1 - written)
    assert float(mean_age(buffer, 2)) == pytest.approx(ages[there].mean())
    leaves = set_priorities(empty_tree(10), jnp.arange(10), jnp.array(weight * there, jnp.float32))[0]
    assert leaves.shape[0] > 10
    assert float(mean_age(buffer, 2, leaves)) == pytest.approx((ages * weight * there).sum() / (weight * there).sum(), rel=1e-5)


def test_an_empty_memory_has_no_age():
    assert float(mean_age(init_replay(row_shapes(SPEC), 5, 2), 2)) == 0.0
