"""BitFlip-v0 against a loop over its bits, and as a goal environment whose goals are judged as its steps are."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from thorndike.environments import registry
from thorndike.environments.native import factory
from thorndike.environments.native.vectorize import vectorize
from thorndike.errors import UserError

BITS, ENVS, STEPS = 5, 8, 60


def test_steps_rewards_and_ends_are_those_of_a_slow_loop():
    environment = vectorize(factory("BitFlip-v0")(bits=BITS), ENVS)
    rng, step = np.random.default_rng(0), jax.jit(environment.step)
    noise = environment.draw(jax.random.key(1), STEPS)
    state, obs = environment.init(jax.random.key(0))
    age = np.zeros(ENVS, int)
    endings = 0
    for t in range(STEPS):
        action = rng.integers(0, BITS, ENVS)
        before = jax.tree.map(np.asarray, obs)
        state, out = step(state, jnp.asarray(action, jnp.int32), jax.tree.map(lambda x, t=t: x[t], noise))
        age += 1
        for b in range(ENVS):
            bits = before["observation"][b].copy()
            bits[action[b]] = 1 - bits[action[b]]
            done = bool((bits == before["desired_goal"][b]).all())
            np.testing.assert_array_equal(out.next_obs["observation"][b], bits)
            np.testing.assert_array_equal(out.next_obs["achieved_goal"][b], bits)
            np.testing.assert_array_equal(out.next_obs["desired_goal"][b], before["desired_goal"][b])
            assert (float(out.reward[b]), bool(out.terminated[b]), bool(out.truncated[b])) == (done - 1.0, done, age[b] == BITS)
            endings += done
            age[b] = 0 if done or age[b] == BITS else age[b]
        obs = out.obs
    assert endings


def test_starts_and_goals_are_fair_coins_independent_of_each_other():
    dynamics = factory("BitFlip-v0")(bits=BITS)
    obs = dynamics.observe(dynamics.reset(dynamics.draw_reset(jax.random.key(3), (20_000,))))
    coins = np.concatenate([obs["observation"], obs["desired_goal"]], axis=1)
    assert set(np.unique(coins)) == {0.0, 1.0}
    np.testing.assert_allclose(np.cov(coins.T), np.eye(2 * BITS) / 4, atol=0.01)
    np.testing.assert_allclose(coins.mean(0), 0.5, atol=0.015)


def test_goals_are_judged_as_steps_are():
    goal = factory("BitFlip-v0")(bits=3).goal
    rows = jnp.array([[0.0, 1.0, 1.0], [0.0, 1.0, 0.0]])
    np.testing.assert_array_equal(goal.reward(rows, rows[::-1]), [-1.0, -1.0])
    np.testing.assert_array_equal(goal.reward(rows, rows), [0.0, 0.0])
    np.testing.assert_array_equal(goal.terminated(rows, rows[:1]), [True, False])


def test_it_is_found_by_id_with_any_number_of_bits_and_evaluated_on_itself():
    choice = registry.resolve("BitFlip-v0", env_kwargs={"bits": 7})
    assert registry.build_native(choice, 2).spec.max_episode_steps == 7
    environment = registry.reference(choice)
    obs, _ = environment.reset(seed=0)
    assert environment.observation_space.contains(obs)
    with pytest.raises(UserError, match="bits is at least 1"):
        registry.build_native(registry.resolve("BitFlip-v0", env_kwargs={"bits": 0}), 1)
    with pytest.raises(UserError, match="native engine alone"):
        registry.resolve("BitFlip-v0", engine="gymnasium")
