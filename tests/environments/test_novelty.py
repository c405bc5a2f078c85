"""Rewards for what is new: against counts and networks kept by hand, apart for each seed, out of the returns that are logged."""

from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from gymnasium import spaces

from environments.test_wrappers import make_spec, make_step
from thorndike.algorithms import ppo
from thorndike.cli.main import main
from thorndike.environments.host.gymnasium_engine import LoopEngine
from thorndike.environments.native import factory
from thorndike.environments.native.vectorize import vectorize
from thorndike.environments.novelty import count_bonus, random_network_distillation
from thorndike.environments.wrapper_names import MODULES, parse_wrapper
from thorndike.environments.wrappers import build_wrapper, chain, frame_stack, from_settings, normalize_observation
from thorndike.errors import UserError
from thorndike.training.host_source import environment_seeds, host_source
from thorndike.training.runner import agent_keys
from thorndike.training.sources import compiled_source
from thorndike.types import Rollout

BOX = spaces.Box(-np.inf, np.inf, (3,), np.float32)
RND = {"coefficient": 2.0, "features": 4, "net_arch": (8,), "batch_size": 4, "learning_rate": 1e-2}


def rollout_of(next_obs, valid=None, reward=0.5) -> Rollout:
    """Steps to ``next_obs`` ``[T, B, ...]``."""
    length, batch = jax.tree.leaves(next_obs)[0].shape[:2]
    flags = np.ones((length, batch), bool) if valid is None else valid
    rows = [make_step(jax.tree.map(lambda x, t=t: x[t], next_obs), reward=reward, valid=flags[t]) for t in range(length)]
    step = jax.tree.map(lambda *leaves: jnp.stack(leaves), *rows)
    return Rollout(next_obs, np.zeros((length, batch), np.int32), (), step, ())


def taught(wrapper, space, *rollouts, num_envs=2):
    """The statistics after some rollouts, and the rewards that each came back with."""
    spec = make_spec(space, num_envs)
    statistics, rewards = wrapper.statistics(spec), []
    memory, learn = wrapper.init(statistics, jax.tree.map(lambda x: x[0], rollouts[0].step.next_obs))[0], jax.jit(wrapper.learn)
    for rollout in rollouts:
        statistics, memory, after = learn(statistics, memory, rollout)
        rewards.append(np.asarray(after.step.reward))
    return statistics, rewards


# counts


@pytest.mark.parametrize("space", [spaces.Discrete(6), spaces.Discrete(6, start=-2)])
def test_a_discrete_observation_has_a_count_of_its_own(space):
    rng = np.random.default_rng(0)
    first, second = (rng.integers(0, 6, (5, 2)).astype(np.int32) + int(space.start) for _ in range(2))
    valid = rng.random((5, 2)) < 0.7
    statistics, rewards = taught(count_bonus(0.3), space, rollout_of(first), rollout_of(second, valid))
    counts = {state: 0 for state in range(int(space.start), int(space.start) + 6)}
    for obs, flags, got in ((first, np.ones_like(valid), rewards[0]), (second, valid, rewards[1])):
        for state in obs[flags]:
            counts[state] += 1
        expected = [0.5 + 0.3 / np.sqrt(counts[state]) if flag else 0.5 for state, flag in zip(obs.ravel(), flags.ravel(), strict=True)]
        np.testing.assert_allclose(got.ravel(), expected, rtol=1e-6)
    assert statistics.shape == (6,)
    assert sorted(statistics.tolist()) == sorted(counts.values())


def test_numbers_are_counted_by_the_cell_they_fall_in():
    obs = np.array([[[0.1, 0.2, 0.3]], [[0.4, 0.05, 0.0]], [[0.6, 0.2, 0.3]], [[-0.1, 0.2, 0.3]]], np.float32)
    _, (reward,) = taught(count_bonus(1.0, resolution=0.5), BOX, rollout_of(obs, reward=0.0), num_envs=1)
    np.testing.assert_allclose(reward[:, 0], [0.5**0.5, 0.5**0.5, 1.0, 1.0], rtol=1e-6)


def test_hashed_counts_rarely_meet():
    obs = np.random.default_rng(0).integers(0, 10, (500, 1, 7, 7, 3)).astype(np.uint8)
    space = spaces.Dict({"image": spaces.Box(0, 255, (7, 7, 3), np.uint8), "action_mask": spaces.MultiBinary(2)})
    shown = {"image": obs, "action_mask": np.ones((500, 1, 2), np.int8)}
    statistics, (reward,) = taught(count_bonus(1.0), space, rollout_of(shown, reward=0.0), num_envs=1)
    assert statistics.shape == (2**20,)
    assert (reward == 1.0).mean() > 0.99


# random network distillation


def test_distillation_rewards_the_error_of_a_prediction_as_computed_by_hand():
    wrapper, rng = random_network_distillation(**RND), np.random.default_rng(1)
    obs = rng.normal(3.0, 2.0, (6, 2, 3)).astype(np.float32)
    valid = np.ones((6, 2), bool)
    valid[2, 1] = False
    before = wrapper.statistics(make_spec(BOX))
    after, (reward,) = taught(wrapper, BOX, rollout_of(obs, valid))
    rows = obs[valid]
    seen = np.clip((obs - rows.mean(0)) / np.sqrt(rows.var(0) + 1e-8), -5, 5).reshape(12, 3)
    goal, guess = network(before.target, (3, 8, 4), seen), network(before.predictor.params, (3, 8, 8, 4), seen)
    error = ((guess - goal) ** 2).mean(-1).reshape(6, 2) * valid
    total, returns = np.zeros(2), []
    for row in error:
        total = 0.99 * total + row
        returns.append(total)
    spread = np.sqrt(np.array(returns)[valid].var() + 1e-8)
    np.testing.assert_allclose(reward, 0.5 + 2.0 * np.clip(error / spread, -10, 10), rtol=1e-4)
    np.testing.assert_array_equal(after.target, before.target)
    # Three minibatches of every third row; Adam's first step is the learning rate along the sign of the gradient.
    params, state, adam = before.predictor.params, optax.scale_by_adam().init(before.predictor.params), optax.scale_by_adam()
    for first in range(3):
        weight = valid.ravel()[first::3].astype(np.float32)

        def loss(params, rows=seen[first::3], goals=goal[first::3], weight=weight):
            return jnp.sum(jnp.mean((network(params, (3, 8, 8, 4), rows) - goals) ** 2, -1) * weight) / weight.sum()

        direction, state = adam.update(jax.grad(loss)(params), state)
        params = params - 1e-2 * direction
    np.testing.assert_allclose(after.predictor.params, params, atol=1e-5)


def network(flat, sizes, x):
    """Dense layers with ReLU between them, from their flat parameters: the last layer stands first, and biases before kernels."""
    shapes = list(pairwise(sizes))
    place, layers = 0, {}
    for n, m in [shapes[-1], *shapes[:-1]]:
        bias, place = flat[place : place + m], place + m
        kernel, place = flat[place : place + n * m].reshape(n, m), place + n * m
        layers[n, m, len(layers)] = bias, kernel
    assert place == len(flat)
    (last, *hidden) = layers.values()
    for bias, kernel in hidden:
        x = jnp.maximum(x @ kernel + bias[None], 0.0)
    return x @ last[1] + last[0][None]


SPACES = {
    "Discrete": spaces.Discrete(5),
    "picture": spaces.Box(0, 255, (8, 8, 2), np.uint8),
    "MiniGrid's": spaces.Dict({"direction": spaces.Discrete(4), "image": spaces.Box(0, 255, (7, 7, 3), np.uint8)}),
    "masked": spaces.Dict({"observation": BOX, "action_mask": spaces.MultiBinary(2)}),
    "numbers": spaces.Tuple([spaces.MultiDiscrete([3, 4]), BOX]),
}


@pytest.mark.parametrize("space", SPACES.values(), ids=SPACES)
def test_what_is_seen_often_earns_less_than_what_is_new(space):
    old, new = ([_sample(space, seed) for _ in range(2)] for seed in (0, 1))

    def repeated(pair):
        return jax.tree.map(lambda a, b: np.broadcast_to(np.stack([a, b]), (4, 2, *np.shape(a))), *pair)

    wrapper = random_network_distillation(**RND | {"n_epochs": 4})
    _, rewards = taught(wrapper, space, *[rollout_of(repeated(old), reward=0.0)] * 40, rollout_of(repeated(new), reward=0.0))
    assert rewards[-1].mean() > 3 * rewards[-2].mean()


def _sample(space, seed):
    space.seed(seed)
    return jax.tree.map(np.asarray, space.sample())


def test_a_wrapper_after_it_that_changes_the_observation_is_refused():
    environment = vectorize(factory("CartPole-v1")(), 4)
    wrapper = chain(random_network_distillation(), frame_stack(2))
    algorithm = ppo.ppo(ppo.Config(n_steps=8, batch_size=16), wrapper.spec(environment.spec))
    source = compiled_source(environment, algorithm, wrapper)

    def collect(key):
        noise = jax.tree.map(lambda leaf: leaf[0], source.draw(key, 1))
        return source.collect(source.init(key), algorithm.actor(algorithm.init(key)), noise)

    with pytest.raises(UserError, match="put it after the wrappers"):
        jax.eval_shape(collect, jax.random.key(0))


# in a run


def test_each_seed_has_its_own_random_network_and_returns_are_the_environments_own():
    environment = vectorize(factory("CartPole-v1")(), 4)
    wrapper = chain(normalize_observation(), random_network_distillation(**RND), count_bonus(0.1, resolution=0.1))
    algorithm = ppo.ppo(ppo.Config(n_steps=64, batch_size=16, net_arch=(8,)), wrapper.spec(environment.spec))
    source = compiled_source(environment, algorithm, wrapper)

    def run(key):
        noise = jax.tree.map(lambda leaf: leaf[0], source.draw(key, 1))
        state, rollout, episodes = source.collect(source.init(key), algorithm.actor(algorithm.init(key)), noise)
        return source.statistics(state)[1].target, rollout.step.reward, episodes

    first, reward, episodes = jax.jit(run)(jax.random.key(0))
    other, _, _ = jax.jit(run)(jax.random.key(1))
    assert not np.array_equal(first, other)
    assert reward.min() > 1.01, "CartPole's reward is 1"
    assert episodes.episodes > 0
    np.testing.assert_array_equal(episodes.return_sum, episodes.length_sum)
    import gymnasium

    engine = LoopEngine([lambda: gymnasium.make("CartPole-v1")] * 8, "CartPole-v1", 500)
    host = host_source(engine, algorithm, wrapper, 0, range(2), 10)
    targets = host.source.init(agent_keys(0, np.arange(2, dtype=np.uint32)).source).statistics[1].target
    assert targets.shape[0] == 2
    assert not np.array_equal(targets[0], targets[1])
    assert len(set(environment_seeds(0, range(2), 4, 0))) == 8


def test_settings_rebuild_the_wrappers_and_words_name_them():
    for text in ("count_bonus", "random_network_distillation(coefficient=0.1, net_arch=(16,))", "frame_stack(k=2)"):
        settings = parse_wrapper(text)
        wrapper = build_wrapper(settings)
        assert from_settings([wrapper.settings]).settings["parts"] == [wrapper.settings]
        assert settings.items() <= {**wrapper.settings, "net_arch": (16,)}.items() or "net_arch" not in settings
    assert all(callable(build_wrapper) and name for name in MODULES)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("count_bons", "did you mean 'count_bonus'"),
        ("count_bonus(coef=1)", "has no setting 'coef'"),
        ("count_bonus(1)", "expected NAME"),
        ("count_bonus(coefficient=x)", "expected NAME"),
        ("count_bonus(coefficient='a')", "must be a number"),
        ("count_bonus(coefficient=-1)", "above 0"),
        ("random_network_distillation(features=0)", "above 0"),
        ("frame_stack", "needs k"),
        ("frame_stack(k=True)", "a whole number"),
        ("select_observation(entries=3)", "a list"),
        ("2 +", "expected NAME"),
    ],
)
def test_a_wrapper_that_cannot_be_is_one_line(words, says, capsys):
    assert main(["train", "ppo", "CartPole-v1", "--wrap", words]) == 2
    err = capsys.readouterr().err
    assert says in err
    assert err.count("\n") == 1
