"""What ``train`` refuses rather than leaves out, how it names a user's file, and the time limits that evaluation keeps."""

import subprocess
import sys

import gymnasium
import jax
import numpy as np
import pytest

import thorndike as td
from thorndike.algorithms import sac
from thorndike.api.loading import bounded
from thorndike.environments import registry, wrappers
from thorndike.environments.native import factory
from thorndike.environments.native.vectorize import vectorize
from thorndike.environments.origins import limit_of, name_of
from thorndike.errors import UserError
from thorndike.training.evaluation import Evaluation
from thorndike.training.policy import Policy
from thorndike.user_code import lasting_name


def test_an_environment_that_only_a_native_engine_has_keeps_its_time_limit_in_evaluation():
    choice = bounded(registry.resolve("BitFlip-v0", env_kwargs={"bits": 4}))
    assert choice.max_episode_steps is None
    assert limit_of(registry.reference(choice)) == 4


@pytest.mark.parametrize(
    "argument", [{"seeds": 2}, {"num_envs": 4}, {"devices": 2}, {"actor_threads": 1}, {"start_from": "run"}, {"env_restarts": 1}]
)
def test_planning_refuses_what_it_has_no_use_for(argument, tmp_path):
    with pytest.raises(UserError, match=f"planning computes the exact values of one table: leave {next(iter(argument))} out"):
        td.train("planning", "FrozenLake-v1", output=tmp_path, **argument)


@pytest.mark.parametrize("argument", [{"seeds": 10**8}, {"num_envs": 10**8}])
def test_numbers_that_fit_nowhere_are_a_plain_mistake(argument, tmp_path):
    with pytest.raises(UserError, match="at most 1,000,000 seeds and environments each"):
        td.train("ppo", "CartPole-v1", output=tmp_path, **argument)


def test_a_class_in_a_file_is_named_by_the_files_absolute_path(tmp_path, monkeypatch):
    (tmp_path / "mine.py").write_text("")
    monkeypatch.chdir(tmp_path)
    assert lasting_name("mine.py:Env") == f"{tmp_path}/mine.py:Env"
    assert [lasting_name(name) for name in ("CartPole-v1", "module:Id-v0", "missing.py:Env")] == [
        "CartPole-v1",
        "module:Id-v0",
        "missing.py:Env",
    ]


def test_an_evaluation_shows_its_figures_and_not_its_hundreds_of_episodes():
    rows = tuple(range(1000))
    shown = repr(Evaluation(None, "CartPole-v1", 100, 1.5, 1.4, 1.0, (1.0, 2.0), (1.5,) * 10, rows))
    assert shown == "Evaluation(CartPole-v1, 10 x 100 episodes: mean 1.5 (95 % interval 1 to 2), iqm 1.4, min 1)"


def test_noise_that_is_coloured_over_time_is_independent_between_the_environments_of_an_evaluation():
    spec = vectorize(factory("Pendulum-v1")(), 1).spec
    learner = sac.sac(sac.Config(noise_color=2.0, buffer_size=10, learning_starts=0, net_arch=(4,)), spec)
    noise = np.asarray(Policy(learner, wrappers.chain(), spec, (), (), 0).noise(jax.random.key(0), 2000)).ravel()
    in_training = np.asarray(learner.draw(jax.random.key(0), 2000)).ravel()
    neighbours, steps = (np.corrcoef(x[1:], x[:-1])[0, 1] for x in (noise, in_training))
    assert abs(neighbours) < 0.1
    assert steps > 0.5


def test_a_device_that_is_not_there_is_one_line(tmp_path):
    words = ["train", "ppo", "CartPole-v1", "--device", "gpu", "--output", str(tmp_path)]
    found = subprocess.run([sys.executable, "-m", "thorndike", *words], capture_output=True, text=True)
    if found.returncode != 0:
        assert (found.returncode, found.stderr.count("\n")) == (2, 1), found.stderr
        assert "--device gpu: JAX has no such device here" in found.stderr


def test_an_environment_wrapped_by_a_class_is_called_by_the_class():
    class Doubled(gymnasium.RewardWrapper):
        def __init__(self):
            super().__init__(gymnasium.make("CartPole-v1"))

        def reward(self, reward):
            return 2 * reward

    assert name_of(Doubled) == "Doubled"


def test_a_learner_as_an_object_takes_what_train_takes(tmp_path):
    learner = td.QLearning("FrozenLake-v1", output=tmp_path, name="lake", max_episode_steps=7, checkpoint_every=500)
    assert learner.learn(1000).result.run.name.endswith("lake")
    assert max(row.length for row in learner.evaluate(5).rows) <= 7
