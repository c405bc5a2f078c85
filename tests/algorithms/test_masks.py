"""Action masks: a forbidden action is never chosen, not in a million steps, by any learner that takes masks."""

from functools import partial

import gymnasium
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces

from algorithms.small_environments import forbidding
from thorndike.algorithms import a2c, a3c, dqn, impala, iqn, ppo, pqn, q_learning, rainbow, reinforce, trpo
from thorndike.environments import wrappers
from thorndike.environments.host.action_masks import mask_in_observation
from thorndike.environments.native.vectorize import vectorize
from thorndike.errors import UserError
from thorndike.functional.exploration import epsilon_greedy
from thorndike.networks.masking import FORBIDDEN, has_mask, masked, without_mask
from thorndike.networks.network import Network
from thorndike.training.runner import runner
from thorndike.training.sources import compiled_source
from thorndike.types import EnvSpec

NUM_ENVS = 64


def train(build, config, iterations: int, components: int = 1):
    """Environment steps made, and the mean of the episodes' returns late in training."""
    environment = vectorize(forbidding(components), NUM_ENVS)
    algorithm = build(config, environment.spec)
    bound = runner(algorithm, compiled_source(environment, algorithm, wrappers.chain()), 0, [0])
    carry, early = bound.advance(bound.init(), 0, iterations - 5)
    _, late = bound.advance(carry, iterations - 5, 5)
    worst = min(float(early.episodes.return_sum[0]), float(late.episodes.return_sum[0]))
    return iterations * bound.steps_per_iteration, worst, float(late.episodes.return_sum[0] / late.episodes.episodes[0])


@pytest.mark.parametrize(
    ("memory", "at_least"),
    [("none", 100_000), pytest.param("none", 1_000_000, marks=pytest.mark.slow), pytest.param("gru", 1_000_000, marks=pytest.mark.slow)],
)
def test_masked_ppo_never_picks_a_forbidden_action(memory, at_least):
    """Starting from random weights, so that forbidden actions would often be the likeliest."""
    config = ppo.Config(total_steps=at_least, n_steps=64, batch_size=4096, n_epochs=1, net_arch=(16,), memory=memory, memory_size=8)
    steps, worst, _ = train(ppo.ppo, config, 1 + at_least // (64 * NUM_ENVS))
    assert steps >= at_least
    assert worst >= 0, "a single forbidden action would have cost 1,000"


@pytest.mark.parametrize(
    ("build", "config", "iterations", "components"),
    [
        (ppo.ppo, ppo.Config(n_steps=16, batch_size=256, learning_rate=3e-3, net_arch=(32,)), 60, 2),
        pytest.param(a2c.a2c, a2c.Config(learning_rate=3e-3, net_arch=(32,)), 600, 1, marks=pytest.mark.slow),
        pytest.param(a3c.a3c, a3c.Config(learning_rate=3e-3, net_arch=(32,)), 600, 1, marks=pytest.mark.slow),
        pytest.param(impala.impala, impala.Config(learning_rate=3e-3, n_steps=5, net_arch=(32,)), 600, 1, marks=pytest.mark.slow),
        pytest.param(trpo.trpo, trpo.Config(n_steps=16, batch_size=256, learning_rate=3e-3, net_arch=(32,)), 60, 2, marks=pytest.mark.slow),
        pytest.param(reinforce.reinforce, reinforce.Config(n_steps=16, learning_rate=1e-2, net_arch=(32,)), 300, 1, marks=pytest.mark.slow),
        (dqn.dqn, dqn.Config(learning_rate=2e-3, learning_starts=512, train_freq=64, gradient_steps=4, gamma=0.5, exploration_final_eps=0.2,
                             target_update_interval=640, double=True, n_step=2, net_arch=(32,), total_steps=60_000), 900, 1),
        (pqn.pqn, pqn.Config(learning_rate=2e-3, n_steps=16, batch_size=256, gamma=0.5, net_arch=(32,), total_steps=100_000), 100, 1),
        pytest.param(rainbow.rainbow, rainbow.Config(learning_rate=2e-3, learning_starts=512, train_freq=64, gradient_steps=4, gamma=0.5,
                     target_update_interval=640, net_arch=(32,), total_steps=60_000), 900, 1, marks=pytest.mark.slow),
        pytest.param(iqn.iqn, iqn.Config(learning_rate=2e-3, learning_starts=512, train_freq=64, gradient_steps=4, gamma=0.5,
                     target_update_interval=640, net_arch=(32, 32), exploration_final_eps=0.2, munchausen=True, total_steps=60_000),
                     900, 1, marks=pytest.mark.slow),
    ],
    ids=["ppo, two components", "a2c", "a3c", "impala", "trpo, two components", "reinforce", "dqn", "pqn", "rainbow", "munchausen iqn"],
)  # fmt: skip
def test_learners_choose_the_best_of_what_is_allowed(build, config, iterations, components, quick_compile):
    _, worst, late = train(build, config, iterations, components)
    assert worst >= 0
    # Eight steps an episode; chance is right about one time in three, exploring DQN about four times in five.
    assert late >= (5.5 if components == 1 else 4.5)


def test_exploration_draws_from_the_allowed_actions_alone():
    uniform = jnp.linspace(0.0, 0.999, 1000)
    allowed = jnp.tile(jnp.array([False, True, True, False]), (1000, 1))
    q = jnp.where(allowed, jnp.array([0.0, 1.0, 0.0, 0.0]), FORBIDDEN)
    action = np.asarray(epsilon_greedy(q, jnp.float32(1.0), uniform, allowed=allowed).action)
    assert set(action) == {1, 2}
    assert abs((action == 1).mean() - 0.5) < 0.01


def test_a_mask_that_allows_nothing_allows_everything():
    spec = EnvSpec("m", spaces.Dict({"observation": spaces.Box(0, 1, (2,)), "action_mask": spaces.MultiBinary(3)}), spaces.Discrete(3), 1)
    network = masked(Network(lambda key, obs: (), lambda params, obs: jnp.ones((2, 3))), spec)
    out = network.apply((), {"observation": jnp.zeros((2, 2)), "action_mask": jnp.array([[0, 0, 0], [1, 0, 1]])})
    np.testing.assert_array_equal(out, [[1, 1, 1], [1, FORBIDDEN, 1]])


def test_the_network_sees_the_observation_without_its_mask():
    inner = spaces.Box(0, 255, (8, 8, 3), np.uint8)
    space = spaces.Dict({"observation": inner, "action_mask": spaces.MultiBinary(2)})
    assert has_mask(space)
    assert without_mask(space) is inner
    two = spaces.Dict({"a": spaces.Discrete(2), "b": spaces.Discrete(3), "action_mask": spaces.MultiBinary(2)})
    assert set(without_mask(two).spaces) == {"a", "b"}


def test_what_masks_are_not_for_is_said():
    mask = spaces.Dict({"observation": spaces.Box(0, 1, (2,)), "action_mask": spaces.MultiBinary(3)})
    with pytest.raises(UserError, match="masks are for Discrete"):
        ppo.ppo(ppo.Config(), EnvSpec("boxed", mask, spaces.Box(-1, 1, (3,)), 8))
    with pytest.raises(UserError, match="needs \\(4,\\)"):
        ppo.ppo(ppo.Config(), EnvSpec("short", mask, spaces.Discrete(4), 8))
    with pytest.raises(UserError, match="a table needs"):
        q_learning.q_learning(q_learning.Config(total_steps=1), EnvSpec("table", mask, spaces.Discrete(3), 1))


class InInfo(gymnasium.Env):
    observation_space, action_space = spaces.Box(0, 1, (2,), np.float32), spaces.MultiDiscrete([2, 3])

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return np.zeros(2, np.float32), {"action_mask": (np.array([1, 0]), np.array([0, 1, 1]))}

    def step(self, action):
        self.t += 1
        return np.ones(2, np.float32), 1.0, False, self.t == 3, {"action_mask": (np.array([0, 1]), np.array([1, 1, 0]))}


class ByMethod(gymnasium.Env):
    observation_space, action_space = spaces.Dict({"x": spaces.Discrete(3)}), spaces.Discrete(3)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = 0
        return {"x": 0}, {}

    def step(self, action):
        assert self.action_masks()[action]
        self.x = (self.x + 1) % 3
        return {"x": self.x}, 1.0, False, False, {}

    def action_masks(self):
        return np.arange(3) != self.x


def test_masks_in_info_and_of_a_method_move_into_the_observation():
    env = mask_in_observation(InInfo)()
    first, _ = env.reset(seed=0)
    np.testing.assert_array_equal(first["action_mask"], [1, 0, 0, 1, 1])
    later, *_ = env.step(np.array([0, 1]))
    np.testing.assert_array_equal(later["action_mask"], [0, 1, 1, 1, 0])
    assert env.observation_space.contains({"observation": later["observation"], "action_mask": later["action_mask"]})
    env = mask_in_observation(lambda: gymnasium.wrappers.TimeLimit(ByMethod(), 5))()
    np.testing.assert_array_equal(env.reset(seed=0)[0]["action_mask"], [0, 1, 1])
    assert set(env.observation_space.spaces) == {"x", "action_mask"}
    np.testing.assert_array_equal(env.step(1)[0]["action_mask"], [1, 0, 1])


def test_an_environment_without_masks_is_left_as_it_is():
    make = partial(gymnasium.make, "CartPole-v1")
    assert mask_in_observation(make) is make
