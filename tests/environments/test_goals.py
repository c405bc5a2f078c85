"""Which host environments' goals a compiled program can judge, and that it judges as they do."""

import gymnasium
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces

import thorndike as td
from thorndike.environments.host.goals import find_goal
from thorndike.environments.host.gymnasium_engine import LoopEngine
from thorndike.errors import UserError


class Walk(gymnasium.Env):
    """A point on a line that is pushed; its goal is a place."""

    distance_threshold = 0.1
    ends_at_goal = False

    def __init__(self) -> None:
        part = spaces.Box(-10.0, 10.0, (1,), np.float64)
        self.observation_space = spaces.Dict({"observation": part, "achieved_goal": part, "desired_goal": part})
        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.goal, self.age = np.zeros(1), self.np_random.uniform(-0.5, 0.5, 1), 0
        return self.seen(), {}

    def step(self, action):
        self.place, self.age = np.clip(self.place + 0.2 * np.asarray(action, np.float64), -10, 10), self.age + 1
        reward = float(self.compute_reward(self.place, self.goal, {"age": self.age}))
        return self.seen(), reward, bool(self.compute_terminated(self.place, self.goal, {})), self.age == 8, {}

    def seen(self):
        return {"observation": self.place.copy(), "achieved_goal": self.place.copy(), "desired_goal": self.goal.copy()}

    def compute_terminated(self, achieved, desired, info):
        return self.ends_at_goal and bool(np.linalg.norm(achieved - desired) <= self.distance_threshold)

    def compute_reward(self, achieved, desired, info):
        return -(np.linalg.norm(achieved - desired, axis=-1) > self.distance_threshold).astype(np.float32)


class Dense(Walk):
    def compute_reward(self, achieved, desired, info):
        return np.exp(-np.linalg.norm(achieved - desired, axis=-1))


class Ending(Walk):
    distance_threshold = 0.3
    ends_at_goal = True


class OwnJax(Walk):
    def compute_reward(self, achieved, desired, info):
        return -(jnp.abs(achieved - desired).sum(axis=-1) ** 0.5)


class Odd(Walk):
    def compute_reward(self, achieved, desired, info):
        return -np.floor(np.linalg.norm(achieved - desired))


class NeedsInfo(Walk):
    def compute_reward(self, achieved, desired, info):
        return -float(info["age"])


@pytest.mark.parametrize("kind", [Walk, Dense, Ending, OwnJax])
def test_what_is_found_judges_as_the_environment_does(kind):
    environment, rng = kind(), np.random.default_rng(3)
    goal = find_goal(environment)
    achieved, desired = rng.uniform(-1, 1, (2, 200, 1)).astype(np.float32)
    reward, ended = np.asarray(goal.reward(achieved, desired)), np.asarray(goal.terminated(achieved, desired))
    assert reward.dtype == np.float32
    for i in range(200):
        assert reward[i] == pytest.approx(float(environment.compute_reward(achieved[i], desired[i], {})), abs=1e-4)
        assert ended[i] == environment.compute_terminated(achieved[i], desired[i], {})
    assert LoopEngine([kind], "walk").spec.goal is not None


@pytest.mark.parametrize("kind", [Odd, NeedsInfo])
def test_what_cannot_be_found_is_refused_in_one_line_before_training(kind, tmp_path):
    assert find_goal(kind()) is None
    settings = {"goal_selection_strategy": "final", "net_arch": (4,)}
    with pytest.raises(UserError, match="hindsight recomputes rewards inside the compiled program") as error:
        td.train("sac", kind, steps=200, settings=settings, output=tmp_path)
    assert "\n" not in str(error.value)
    assert not list(tmp_path.iterdir())


def test_environments_without_goals_have_none_to_find():
    assert find_goal(gymnasium.make("CartPole-v1")) is None


def test_wrappers_that_would_change_goals_or_rewards_are_refused(tmp_path):
    wrappers = [td.wrappers.normalize_reward(0.99)]
    with pytest.raises(UserError, match="leave out the wrapper"):
        td.train("sac", Walk, steps=200, settings={"goal_selection_strategy": "final"}, wrappers=wrappers, output=tmp_path)


def test_a_host_environment_trains_with_hindsight(tmp_path):
    settings = {"goal_selection_strategy": "future", "net_arch": (4,), "learning_starts": 20, "batch_size": 8, "train_freq": 8}
    run = td.train("ddpg", Walk, steps=64, settings=settings, output=tmp_path)
    policy = td.load(run.run, environment=Walk)
    obs, _ = Walk().reset(seed=0)
    assert np.abs(policy.predict(obs)[0]).max() <= 1.0


def test_a_maze_of_gymnasium_robotics_is_found_by_its_id():
    pytest.importorskip("gymnasium_robotics")
    environment = td.make("PointMaze_UMaze-v3", engine="gymnasium")
    try:
        reward = environment.spec.goal.reward(jnp.zeros((2, 2)), jnp.array([[0.1, 0.0], [1.0, 0.0]]))
    finally:
        environment.close()
    np.testing.assert_array_equal(reward, [1.0, 0.0])


def test_an_arm_that_this_mujoco_cannot_move_is_refused_with_advice(monkeypatch):
    pytest.importorskip("gymnasium_robotics")
    monkeypatch.setattr("thorndike.environments.origins._joints_are_numbers", lambda: False)
    with pytest.raises(UserError, match="pip install mujoco==") as error:
        td.make("FetchReach-v4")
    assert "\n" not in str(error.value)
