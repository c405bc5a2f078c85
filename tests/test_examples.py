"""The scripts of examples/ do what they say, at a small size."""

import importlib.util
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete
from gymnasium.utils.env_checker import check_env

from thorndike.types import EnvSpec

EXAMPLES = Path(__file__).parents[1] / "examples"


def load(name):
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.filterwarnings("ignore:.*alternative render modes.*")
def test_the_courier_is_an_environment_as_gymnasium_wants_it():
    courier = load("own_environment").Courier(size=4, render_mode="rgb_array")
    check_env(courier)
    assert courier.render().shape == (128, 128, 3)


def test_the_courier_delivers_and_the_episode_terminates():
    courier = load("own_environment").Courier(size=5)
    courier.reset(seed=0)
    courier.courier, courier.parcel = np.array([1, 0]), np.array([1, 1])
    obs, reward, terminated, _, _ = courier.step(0)
    assert (obs["carrying"], round(reward, 2), terminated) == (1, 0.48, False)
    courier.step(1)
    _, reward, terminated, truncated, _ = courier.step(3)
    assert (round(reward, 2), terminated, truncated) == (0.98, True, False)


def test_a_network_of_ones_own_gives_logits_and_values():
    spec = EnvSpec("any", Box(-1.0, 1.0, (2, 3)), Discrete(4), num_envs=1)
    network, obs = load("own_network").shared_body(spec, 4), jnp.ones((5, 2, 3))
    with jax.numpy_rank_promotion("allow"):
        logits, values = network.apply(network.init(jax.random.key(0), obs), obs)
    assert (logits.shape, values.shape) == ((5, 4), (5,))


@pytest.mark.slow
def test_a_network_of_ones_own_learns(tmp_path):
    with jax.numpy_rank_promotion("allow"):
        found = load("own_network").main(steps=20_000, seeds=2, output=tmp_path)
    assert found.mean > 60


@pytest.mark.slow
def test_a_hint_leads_to_the_goal(tmp_path):
    plain, shaped = load("reward_shaping").main(output=tmp_path)
    assert shaped.mean > plain.mean


def test_the_hint_is_one_at_the_goal_and_zero_in_the_other_corner():
    nearness = load("reward_shaping").nearness
    assert nearness(np.array([0, 63, 7])).tolist() == [0.0, 1.0, 0.5]
