"""Batches that reset themselves: true successors, exact time limits, stable types, seeds as an axis."""

import functools

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from thorndike.environments.native import NATIVE, factory, is_only_native
from thorndike.environments.native.randomness import uniforms
from thorndike.environments.native.table import read_table, table_dynamics
from thorndike.environments.native.vectorize import Dynamics, vectorize
from thorndike.environments.origins import make_single
from thorndike.environments.probes import counting
from thorndike.errors import UserError
from thorndike.types import Environment, Step


def rollout(environment: Environment, actions: jax.Array, key: jax.Array) -> tuple[jax.Array, Step]:
    """First observation and all steps ``[T, B, ...]`` under these actions ``[T, B, ...]``."""
    key_init, key_draw = jax.random.split(key)
    state, first = environment.init(key_init)
    noise = environment.draw(key_draw, len(actions))
    return first, jax.lax.scan(lambda state, row: environment.step(state, *row), state, (actions, noise))[1]


def frozen_lake() -> Dynamics:
    return table_dynamics(read_table(gymnasium.make("FrozenLake-v1")))


@pytest.mark.parametrize("limit", [None, 5, 7])
def test_no_false_transition_in_100_000_counted_steps(limit: int | None) -> None:
    environment = vectorize(counting(length=7, max_episode_steps=limit), 100)
    first, steps = jax.jit(functools.partial(rollout, environment))(jnp.zeros((1000, 100), jnp.int32), jax.random.key(0))
    obs, next_obs = (np.asarray(leaf)[..., 0] for leaf in (steps.obs, steps.next_obs))
    before = np.concatenate([np.asarray(first).T, obs[:-1]])
    np.testing.assert_array_equal(next_obs, before + 1)
    np.testing.assert_array_equal(steps.terminated, next_obs == 7)
    np.testing.assert_array_equal(steps.truncated, next_obs >= (limit or np.inf))
    np.testing.assert_array_equal(obs, np.where(steps.done, 0, next_obs))
    assert np.asarray(steps.valid).all()
    assert next_obs.max() == min(7, limit or 7)


def test_the_clock_starts_again_with_every_episode() -> None:
    environment = vectorize(frozen_lake(), 50, max_episode_steps=6)
    actions = jax.random.randint(jax.random.key(1), (300, 50), 0, 4)
    _, steps = jax.jit(functools.partial(rollout, environment))(actions, jax.random.key(0))
    elapsed = np.zeros(50, int)
    for terminated, truncated in zip(np.asarray(steps.terminated), np.asarray(steps.truncated), strict=True):
        elapsed += 1
        np.testing.assert_array_equal(truncated, elapsed == 6)
        elapsed[terminated | truncated] = 0
    assert (np.asarray(steps.terminated) & ~np.asarray(steps.truncated)).any(), "some episodes end before the limit"


def test_no_clock_is_kept_without_a_limit() -> None:
    unlimited, _ = vectorize(counting(), 3).init(jax.random.key(0))
    limited, _ = vectorize(counting(), 3, max_episode_steps=9).init(jax.random.key(0))
    assert len(jax.tree.leaves(unlimited)) == 1
    assert limited.clock.dtype == jnp.int32


@pytest.mark.parametrize("name", ["CartPole-v1", "FrozenLake-v1"])
def test_a_vmapped_seed_equals_that_seed_alone(name: str) -> None:
    environment = vectorize(frozen_lake() if name == "FrozenLake-v1" else factory(name)(), 4, max_episode_steps=20)
    keys = jax.random.split(jax.random.key(3), 3)
    actions = jax.random.randint(jax.random.key(4), (40, 4), 0, 2)
    alone = jax.jit(functools.partial(rollout, environment, actions))
    many = jax.tree.map(np.asarray, jax.jit(jax.vmap(functools.partial(rollout, environment, actions)))(keys))
    for i, key in enumerate(keys):
        for one, row in zip(jax.tree.leaves(alone(key)), jax.tree.leaves(many), strict=True):
            np.testing.assert_allclose(row[i], one, rtol=1e-4, atol=1e-5)
    assert not np.array_equal(many[1].obs[0], many[1].obs[1]), "seeds differ"


@pytest.mark.parametrize("id", [*NATIVE, "FrozenLake-v1"])
def test_types_are_strong_and_stable(id: str) -> None:
    environment = vectorize(frozen_lake() if id == "FrozenLake-v1" else factory(id)(), 3)
    space = environment.spec.action_space
    action = jax.ShapeDtypeStruct((3, *space.shape), jnp.int32 if isinstance(space, gymnasium.spaces.Discrete) else jnp.float32)

    def two_steps(key: jax.Array, action: jax.Array) -> tuple:
        state, obs = environment.init(key)
        noise = jax.tree.map(lambda leaf: leaf[0], environment.draw(key, 1))
        after, step = environment.step(state, action, noise)
        return state, after, obs, step

    with jax.numpy_rank_promotion("raise"):
        state, after, obs, step = jax.eval_shape(two_steps, jax.random.key(0), action)
    assert not any(leaf.weak_type for leaf in jax.tree.leaves((state, after, obs, step)))
    assert jax.tree.structure(state) == jax.tree.structure(after)
    assert [(a.shape, a.dtype) for a in jax.tree.leaves(state)] == [(a.shape, a.dtype) for a in jax.tree.leaves(after)]
    assert step.obs == step.next_obs == obs
    assert all(leaf.dtype in (jnp.float32, jnp.int32, jnp.bool_) for leaf in jax.tree.leaves(obs))
    assert [a.shape[1:] for a in jax.tree.leaves(obs)] == [part.shape for part in _parts(environment.spec.observation_space)]
    assert [leaf.dtype for leaf in step[2:7]] == [jnp.float32, jnp.float32, jnp.bool_, jnp.bool_, jnp.bool_]
    assert all(leaf.shape == (3,) for leaf in step[2:7])


def _parts(space: gymnasium.Space) -> list[gymnasium.Space]:
    if isinstance(space, gymnasium.spaces.Dict):
        return [space[name] for name in sorted(space.spaces)]
    return list(space) if isinstance(space, gymnasium.spaces.Tuple) else [space]


@pytest.mark.parametrize("id", [id for id in NATIVE if not is_only_native(id)])
def test_spaces_and_limits_are_gymnasiums(id: str) -> None:
    dynamics, theirs = factory(id)(), make_single(id, {})
    assert dynamics.observation_space == theirs.observation_space
    assert dynamics.action_space == theirs.action_space
    assert (dynamics.id, dynamics.max_episode_steps) == (id, theirs.spec.max_episode_steps)


STARTS = {
    "CartPole-v1": ([-0.05] * 4, [0.05] * 4),
    "Acrobot-v1": ([-0.1] * 4, [0.1] * 4),
    "MountainCar-v0": ([-0.6, 0], [-0.4, 0]),
    "MountainCarContinuous-v0": ([-0.6, 0], [-0.4, 0]),
    "Pendulum-v1": ([-np.pi, -1], [np.pi, 1]),
}


@pytest.mark.parametrize("id", STARTS)
def test_starts_are_uniform_in_gymnasiums_range(id: str) -> None:
    dynamics = factory(id)()
    state = np.asarray(dynamics.reset(dynamics.draw_reset(jax.random.key(2), (20_000,))), float)
    low, high = (np.array(bound) for bound in STARTS[id])
    spread = np.where(high > low, high - low, 1)
    fraction = (state - low) / spread
    assert fraction.min() > -1e-6 and fraction.max() < 1 + 1e-6
    moving = fraction[:, high > low]
    deciles = np.stack([np.histogram(column, 10, (0, 1))[0] for column in moving.T])
    assert (np.square(deciles - 2000) / 2000).sum(axis=1).max() < 35, "chi-squared with 9 degrees of freedom, p below 1e-4"


def test_numbers_spread_from_one_word_are_independent() -> None:
    numbers = np.asarray(uniforms(jax.random.bits(jax.random.key(6), (50_000,), jnp.uint32), 4, 0.0, 1.0))
    correlation = np.corrcoef(np.concatenate([numbers, np.square(numbers - 0.5)], axis=1).T) - np.eye(8)
    assert np.abs(correlation).max() < 0.02
    for first, second in ((0, 1), (0, 3), (1, 2), (2, 3)):
        counts, *_ = np.histogram2d(numbers[:, first], numbers[:, second], 16, ((0, 1), (0, 1)))
        assert (np.square(counts - 195.3125) / 195.3125).sum() < 355, "chi-squared with 255 degrees of freedom, p below 1e-4"


def test_wrong_counts_and_unknown_ids_say_what_is_expected() -> None:
    with pytest.raises(UserError, match="num_envs of CartPole-v1 must be at least 1, not 0"):
        vectorize(factory("CartPole-v1")(), 0)
    with pytest.raises(UserError, match="max_episode_steps of CartPole-v1"):
        vectorize(factory("CartPole-v1")(), 1, max_episode_steps=0)
    with pytest.raises(UserError, match="'Walker-v1' has no native engine: expected one of CartPole-v1"):
        factory("Walker-v1")
