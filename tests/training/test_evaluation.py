"""Evaluation: every seed, as many episodes of each environment, the environment's own returns, nothing learnt."""

from functools import partial

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from thorndike.algorithms import ppo
from thorndike.environments import wrappers
from thorndike.environments.host.gymnasium_engine import LoopEngine
from thorndike.environments.host.vector_engine import VectorEngine
from thorndike.training.evaluation import evaluate
from thorndike.training.policy import Policy
from thorndike.types import EnvSpec
from training.tiny_environments import Corridor, Lengths

pytestmark = pytest.mark.usefixtures("quick_compile")


def policy_for(environment: type[gymnasium.Env], *parts, seeds: int = 2) -> Policy:
    wrapper = wrappers.chain(*parts)
    spec = EnvSpec("e", environment.observation_space, environment.action_space, 4)
    learner = ppo.ppo(ppo.Config(n_steps=8, batch_size=8, net_arch=(8,)), wrapper.spec(spec))
    actors = jax.vmap(lambda key: learner.actor(learner.init(key)))(jax.random.split(jax.random.key(0), seeds))
    statistics = jax.tree.map(lambda x: jnp.broadcast_to(x, (seeds, *jnp.shape(x))), wrapper.statistics(spec))
    return Policy(learner, wrapper, spec, actors, statistics, 0)


def loop(environment: type[gymnasium.Env], number: int) -> LoopEngine:
    return LoopEngine([environment] * number, environment.__name__)


def vector(mode: AutoresetMode, environment: type[gymnasium.Env], number: int) -> VectorEngine:
    return VectorEngine(SyncVectorEnv([environment] * number, autoreset_mode=mode), environment.__name__)


@pytest.mark.parametrize(("episodes", "num_envs", "used"), [(10, 20, 10), (10, 4, 2), (7, 4, 1), (1, 1, 1), (12, 5, 4)])
def test_each_seed_plays_the_number_of_episodes_asked_for_in_equal_shares(episodes, num_envs, used):
    sizes = []

    def build(number):
        sizes.append(number)
        return loop(Lengths, number)

    found = evaluate(policy_for(Lengths), build, episodes, num_envs=num_envs)
    assert sizes == [2 * used]
    assert found.episodes == episodes
    assert [(row.seed, row.episode) for row in found.rows] == [(s, e) for s in range(2) for e in range(episodes)]
    # Episode k of each environment takes 1 + 7 k mod 5 steps, whose rewards are 1, 2, ...; deaths and limits alternate.
    each = episodes // used
    for row in found.rows:
        number = row.episode % each
        length = 1 + 7 * number % 5
        assert (row.length, row.total, row.terminated) == (length, length * (length + 1) / 2, number % 2 == 0)


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_dead_rows_are_no_steps_and_no_episodes(mode):
    policy = policy_for(Lengths)
    found = evaluate(policy, partial(vector, mode, Lengths), 20, num_envs=2)
    assert found.rows == evaluate(policy, partial(loop, Lengths), 20, num_envs=2).rows


def test_the_summary_is_over_the_seeds_means():
    found = evaluate(policy_for(Corridor, seeds=3), partial(loop, Corridor), 12, deterministic=False)
    means = [np.mean([row.total for row in found.rows if row.seed == seed]) for seed in range(3)]
    np.testing.assert_allclose(found.per_seed, means)
    assert found.mean == pytest.approx(np.mean(means))
    assert found.min == pytest.approx(min(means))
    assert found.ci95[0] <= found.mean <= found.ci95[1]
    assert (found.environment, found.run) == ("Corridor", None)


def test_the_same_seed_gives_the_same_episodes_and_another_does_not():
    policy = policy_for(Corridor)
    first, again, other = (evaluate(policy, partial(loop, Corridor), 20, seed=s, deterministic=False).rows for s in (0, 0, 1))
    assert first == again
    assert first != other


class GreedyOrNot(Corridor):
    """One step, whose reward is the action."""

    def step(self, action):
        return self.observe(), float(action), True, False, {}

    def observe(self):
        return np.zeros(3, np.float32)


def test_drawn_actions_vary_and_deterministic_ones_do_not():
    policy = policy_for(GreedyOrNot)
    fixed, drawn = (evaluate(policy, partial(loop, GreedyOrNot), 40, deterministic=d) for d in (True, False))
    for seed in range(2):
        assert len({row.total for row in fixed.rows if row.seed == seed}) == 1
        assert 0.2 < drawn.per_seed[seed] < 0.8


class FarAway(gymnasium.Env):
    """Observations far from anything seen in training, and rewards as large."""

    observation_space = spaces.Box(-np.inf, np.inf, (1,))
    action_space = spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.age = 0
        return np.array([1e4], np.float32), {}

    def step(self, action):
        self.age += 1
        return np.array([1e4 + self.age], np.float32), 1e6 * (1 + action), False, self.age == 5, {}


def test_normalisers_are_frozen_and_returns_are_the_environments_own():
    """Norm-1: statistics that went on learning in evaluation would make its result depend on what was evaluated before."""
    policy = policy_for(FarAway, wrappers.normalize_observation(), wrappers.normalize_reward(0.9))
    before = jax.tree.map(np.array, policy.statistics)
    build = partial(loop, FarAway)
    first = evaluate(policy, build, 4)
    evaluate(policy, build, 20, seed=9)
    assert evaluate(policy, build, 4) == first
    assert all(5e6 <= row.total <= 1e7 and row.total % 1e6 == 0 for row in first.rows)
    for a, b in zip(jax.tree.leaves(before), jax.tree.leaves(policy.statistics), strict=True):
        np.testing.assert_array_equal(a, b)


def test_evaluation_never_plays_the_seeds_of_training():
    from thorndike.training.evaluation import _EVALUATION
    from thorndike.training.host_source import environment_seeds

    played = environment_seeds(0, range(8), 20, _EVALUATION)
    trained = [seed for stream in range(50) for seed in environment_seeds(0, range(8), 20, stream)]
    assert not set(played) & set(trained)


def test_the_pool_is_closed_even_after_a_failure():
    closed = []

    class Failing(LoopEngine):
        def step(self, actions):
            raise RuntimeError("the simulator fell over")

        def close(self):
            closed.append(True)

    with pytest.raises(RuntimeError, match="fell over"):
        evaluate(policy_for(Corridor), lambda number: Failing([Corridor] * number, "Corridor"), 2)
    assert closed == [True]


@pytest.mark.parametrize("mode", [None, *AutoresetMode])
def test_values_of_first_observations_are_held_against_discounted_returns(mode):
    """A slow loop plays the same episodes: a reward of ``age`` a step, deaths and limits in turn, whatever the engine's reset."""
    policy, gamma = policy_for(Lengths), 0.9
    build = partial(loop, Lengths) if mode is None else partial(vector, mode, Lengths)
    found = evaluate(policy, build, 12, num_envs=2, gamma=gamma)
    value = jax.jit(policy.algorithm.value)
    for row in found.rows:
        number = row.episode % 6
        actor = jax.tree.map(lambda x, seed=row.seed: x[seed], policy.actors)
        first, last = (np.asarray(value(actor, jnp.array([[age, number]], jnp.float32)))[0] for age in (0, row.length))
        worth = sum(gamma**t * (t + 1) for t in range(row.length)) + (0 if row.terminated else gamma**row.length * last)
        assert (row.value, row.discounted) == pytest.approx((first, worth), rel=1e-5)
    by_seed = [np.mean([row.value - row.discounted for row in found.rows if row.seed == seed]) for seed in range(2)]
    assert found.value_bias.per_seed == pytest.approx(by_seed)
    assert found.value_bias.mean == pytest.approx(np.mean(by_seed))
    assert found.value_bias.ci95[0] <= found.value_bias.mean <= found.value_bias.ci95[1]
    without = evaluate(policy, build, 12, num_envs=2)
    assert without.value_bias is None
    assert [row[:5] for row in without.rows] == [row[:5] for row in found.rows]
