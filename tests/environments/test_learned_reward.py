"""A learnt reward as a wrapper: the numbers of an ensemble by hand, wherever it stands in a chain."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces
from jax.flatten_util import ravel_pytree

from environments.test_wrappers import make_spec, make_step
from thorndike.environments.learned_reward import LearnedReward, learned_reward, no_reward
from thorndike.environments.wrapper_names import parse_wrapper
from thorndike.environments.wrappers import build_wrapper, chain, normalize_observation
from thorndike.errors import UserError
from thorndike.functional.normalization import Moments

OBS, ACT = spaces.Box(-np.inf, np.inf, (3,), np.float32), spaces.Discrete(2)
RNG = np.random.default_rng(0)
BATCH, HIDDEN = 5, (4, 4)


def learnt(members=2) -> LearnedReward:
    """Any numbers at all."""
    blank = no_reward((OBS, ACT), members, HIDDEN)
    observations = (Moments(jnp.float32(9), jnp.array([1.0, 0.0, -2.0]), jnp.array([4.0, 1.0, 0.25])),)
    actions = Moments(jnp.float32(9), jnp.array([0.5, 0.5]), jnp.array([0.25, 0.25]))
    params = jnp.asarray(RNG.normal(size=blank.params.shape), jnp.float32)
    return LearnedReward(params, observations, actions, jnp.array([0.3, -0.1][:members]), jnp.array([2.0, 0.5][:members]))


def by_hand(held: LearnedReward, obs, action):
    """The reward of one step, with layers written out."""
    (own,) = held.observations
    seen = [(obs[i] - own.mean[i]) / np.sqrt(own.variance[i]) for i in range(3)]
    chosen = [((action == i) - held.actions.mean[i]) / np.sqrt(held.actions.variance[i]) for i in range(2)]
    # Flax names layers in the order in which they are made; their biases come before their kernels.
    layers = {f"Dense_{n}": {"bias": np.zeros(b), "kernel": np.zeros((a, b))} for n, (a, b) in enumerate([(5, 4), (4, 4), (4, 1)])}
    _, unravel = ravel_pytree(layers)
    worth = []
    for params, level, spread in zip(held.params, held.level, held.spread, strict=True):
        named, x = unravel(params), np.array(seen + chosen)
        for n in range(3):
            x = x @ named[f"Dense_{n}"]["kernel"] + named[f"Dense_{n}"]["bias"]
            if n < 2:
                x = np.where(x > 0, x, 0.01 * x)
        worth.append((x[0] - level) / spread)
    return sum(worth) / len(worth)


@pytest.fixture(scope="module")
def stepped():
    wrapper, held = learned_reward(2, HIDDEN), learnt()
    obs, action = RNG.normal(size=(BATCH, 3)).astype(np.float32), RNG.integers(0, 2, BATCH).astype(np.int32)
    valid = np.array([True, True, False, True, True])
    step = make_step(obs + 1, reward=7.0, valid=valid)
    memory, _ = wrapper.init(held, obs)
    return held, obs, action, valid, jax.jit(wrapper.step)(held, memory, obs, action, step)[1]


def test_the_reward_is_the_mean_of_the_members_brought_to_one_scale(stepped):
    held, obs, action, valid, step = stepped
    wanted = [by_hand(held, obs[row], action[row]) if valid[row] else 0.0 for row in range(BATCH)]
    np.testing.assert_allclose(step.reward, wanted, rtol=2e-4, atol=1e-5)


def test_it_looks_at_what_the_environment_shows_whatever_wrappers_follow(stepped):
    held, obs, action, valid, alone = stepped
    both = chain(learned_reward(2, HIDDEN), normalize_observation())
    spec = make_spec(OBS, BATCH)
    statistics = (held, *both.statistics(spec)[1:])
    memory, seen = both.init(statistics, obs)
    _, step = jax.jit(both.step)(statistics, memory, seen, action, make_step(obs + 1, reward=7.0, valid=valid))
    np.testing.assert_allclose(step.reward, alone.reward, rtol=1e-5)


def test_nothing_learnt_is_worth_nothing_and_settings_build_it_again():
    wrapper = learned_reward(3, [8])
    again = build_wrapper(wrapper.settings)
    spec = make_spec(spaces.Discrete(4), 2)
    fresh, other = wrapper.statistics(spec), again.statistics(spec)
    assert jax.tree.map(jnp.shape, fresh) == jax.tree.map(jnp.shape, other) and again.settings == wrapper.settings
    obs = np.array([0, 3], np.int32)
    _, step = again.step(fresh, again.init(fresh, obs)[0], obs, np.array([0, 1], np.int32), make_step(obs, reward=5.0))
    np.testing.assert_array_equal(step.reward, [0.0, 0.0])


def test_it_needs_a_folder_and_a_size():
    with pytest.raises(UserError, match="--reward DIR"):
        parse_wrapper("learned_reward(members=3)")
    with pytest.raises(UserError, match="at least one member"):
        learned_reward(0)
