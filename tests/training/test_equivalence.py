"""The same learning whatever steps the environment, however it resets, and however often it is stopped."""

import json
import os
import signal
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from thorndike.algorithms import ppo
from thorndike.api import resume, train
from thorndike.environments import wrappers
from thorndike.environments.host.gymnasium_engine import LoopEngine
from thorndike.environments.host.vector_engine import VectorEngine
from thorndike.environments.native import factory
from thorndike.environments.native.randomness import no_noise
from thorndike.environments.native.vectorize import vectorize
from thorndike.networks.heads import actor_critic
from thorndike.training import progress
from thorndike.training.host_source import environment_seeds, host_source
from thorndike.training.run_directory import read_run
from thorndike.training.runner import runner
from thorndike.training.sources import compiled_source
from thorndike.types import Environment, Step, Wrapper
from training.tiny_environments import PPO_SETTINGS, Corridor, InterruptedCorridor, Lengths

pytestmark = pytest.mark.usefixtures("quick_compile")
SEEDS, NUM_ENVS = 2, 3
TIMES = {"wall_s", "cpu_s", "time/fps", "time/environment", "time/acting", "time/learning", "time/waiting"}


class NativeHost:
    """A native environment stepped from Python as a host engine is."""

    def __init__(self, environment: Environment) -> None:
        self.spec = environment.spec._replace(engine="gymnasium")
        self._environment, self._step = environment, jax.jit(environment.step)
        self._noise = jax.tree.map(lambda leaf: leaf[0], environment.draw(jax.random.key(0), 1))

    def reset(self, seeds: Sequence[int]):
        self._state, obs = self._environment.init(jax.random.key(seeds[0]))
        return np.asarray(obs)

    def step(self, actions: np.ndarray) -> Step:
        self._state, step = self._step(self._state, actions, self._noise)
        return jax.tree.map(np.asarray, step)

    def close(self) -> None:
        pass


def cartpole_without_chance():
    """CartPole from one start, whose episodes end by falling (action by action) or after 25 steps."""
    fixed = {"reset": lambda noise: jnp.array([0.01, -0.02, 0.03, 0.02]), "draw_reset": no_noise, "max_episode_steps": 25}
    return factory("CartPole-v1")()._replace(**fixed)


def test_a_compiled_loop_learns_what_a_host_loop_learns():
    wrapper = wrappers.chain(wrappers.normalize_observation(), wrappers.frame_stack(2), wrappers.normalize_reward(0.99))
    dynamics = cartpole_without_chance()
    native = vectorize(dynamics, NUM_ENVS)
    config = ppo.Config(total_steps=10_000, n_steps=16, batch_size=24, n_epochs=2, net_arch=(8,), learning_rate=1e-3)
    algorithm = ppo.ppo(config, wrapper.spec(native.spec))

    def telling(state, rollout, key):
        """The whole rollout among the metrics, so that it comes out of the compiled loop."""
        after, reported = algorithm.update(state, rollout, key)
        step = rollout.step
        rows = {"obs": rollout.obs, "next": step.next_obs, "following": step.obs, "reward": step.reward, "action": rollout.action}
        ends = {"terminated": step.terminated, "truncated": step.truncated, "valid": step.valid}
        return after, reported | {name: x.astype(jnp.float32) for name, x in (rows | ends).items()}

    told = algorithm._replace(update=telling)
    # A compiled source splits its key between acting and the environment; a host source has no environment to draw for.
    host = told._replace(draw=lambda key, steps: algorithm.draw(jax.random.split(key)[0], steps))
    compiled = runner(told, compiled_source(native, told, wrapper), 0, range(SEEDS))
    engine = NativeHost(vectorize(dynamics, SEEDS * NUM_ENVS))
    stepped = runner(host, host_source(engine, host, wrapper, 0, range(SEEDS), reseed_every=10**6), 0, range(SEEDS))
    ours, theirs = compiled.init(), stepped.init()
    ended = 0
    for iteration in range(5):
        ours, report = compiled.advance(ours, iteration, 1)
        theirs, host_report = stepped.advance(theirs, iteration, 1)
        ended += np.sum(report.episodes.episodes)
        for name in report.metrics:
            tolerance = {"rtol": 1e-5, "atol": 1e-5} if "/" not in name else {"rtol": 1e-3, "atol": 1e-4}
            np.testing.assert_allclose(report.metrics[name], host_report.metrics[name], **tolerance, err_msg=f"{name}, {iteration}")
        for a, b in zip(report.episodes, host_report.episodes, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-5)
    assert ended > 10, "episodes ended on the way"
    for a, b in zip(jax.tree.leaves(ours.learner.params), jax.tree.leaves(theirs.learner.params), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5)
    for a, b in zip(jax.tree.leaves(ours.source.statistics), jax.tree.leaves(theirs.source.statistics), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5)


def targets_of(engine, length: int) -> list[np.ndarray]:
    """Of each environment: observation, reward, value, advantage and value target of every row that is a transition."""
    config = ppo.Config(n_steps=length, batch_size=2, net_arch=(8,), gamma=0.9, gae_lambda=0.8)
    algorithm = ppo.ppo(config, engine.spec)
    source = host_source(engine, algorithm, wrappers.chain(), 0, [0], reseed_every=10**6).source
    params = jax.vmap(algorithm.init)(jax.random.split(jax.random.key(3), 1)).params
    noise = jax.vmap(lambda key: jax.tree.map(lambda x: x[0], source.draw(key, 1)))(jax.random.split(jax.random.key(4), 1))
    _, rollout, episodes = source.collect(source.init(jax.random.split(jax.random.key(5), 1)), params, noise)
    network = actor_critic(engine.spec.observation_space, 2, 0, config.net_arch, config.activation)
    one = jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), (rollout, params))
    batch = ppo.prepare(*one, network, config)
    assert float(episodes.steps[0]) == float(batch.weight.sum())
    columns = jnp.concatenate([batch.obs, *(x[:, None] for x in (batch.value, batch.advantage, batch.target, batch.weight))], axis=1)
    by_env = np.asarray(columns).reshape(length, engine.spec.num_envs, -1)
    return [rows[rows[:, -1] > 0] for rows in by_env.transpose(1, 0, 2)]


def vector(mode: AutoresetMode) -> VectorEngine:
    return VectorEngine(SyncVectorEnv([Lengths] * 2, autoreset_mode=mode), "Lengths")


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED])
def test_every_autoreset_mode_gives_the_same_training_targets(mode):
    """15 steps in 5 episodes, of which NEXT_STEP takes 20 rows: compared as far as the last complete episode."""
    same, other = (targets_of(engine, 40) for engine in (vector(AutoresetMode.SAME_STEP), vector(mode)))
    loop = targets_of(LoopEngine([Lengths] * 2, "Lengths"), 40)
    for first, second, third in zip(same, other, loop, strict=True):
        rows = 30
        assert len(second) >= rows
        np.testing.assert_allclose(second[:rows], first[:rows], rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(third, first, rtol=1e-4, atol=1e-4)


def logged(run: Path) -> list[dict]:
    """metrics.jsonl without what the clock says."""
    rows = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    return [{name: value for name, value in row.items() if name not in TIMES} for row in rows]


def policy_bytes(run: Path) -> bytes:
    return (run / "policy" / "policy.safetensors").read_bytes()


def normalising() -> list[Wrapper]:
    return [wrappers.normalize_observation(), wrappers.normalize_reward(0.99)]


def train_corridor(output: Path, environment: type[gymnasium.Env], steps: int):
    """A rollout of 4 environments is 32 steps; a checkpoint, and new seeds, after every third."""
    return train(
        "ppo",
        environment,
        steps=steps,
        seeds=2,
        num_envs=4,
        settings=PPO_SETTINGS,
        output=output,
        checkpoint_every=96,
        wrappers=normalising(),
    )


def test_a_resumed_host_run_is_the_run_that_was_never_stopped(tmp_path):
    whole = train_corridor(tmp_path / "whole", Corridor, 320)
    InterruptedCorridor.steps_made, InterruptedCorridor.presses_at = 0, 4 * 2 * 8 * 5 - 20
    stopped = train_corridor(tmp_path / "stopped", InterruptedCorridor, 320)
    assert (stopped.status, stopped.steps) == ("interrupted", 160), "in the fifth rollout, two after the checkpoint"
    assert len(logged(stopped.run)) == 5
    with (stopped.run / "metrics.jsonl").open("a") as file:
        file.write('{"steps": 1')  # what a killed process leaves behind
    resumed = resume(stopped.run, environment=Corridor)
    assert (resumed.status, resumed.steps, resumed.seeds) == ("finished", 384, 2), "a run ends at a checkpoint"
    assert logged(resumed.run) == logged(whole.run)
    assert policy_bytes(resumed.run) == policy_bytes(whole.run)
    assert [path.name for path in sorted((resumed.run / "checkpoints").iterdir())] == ["288", "384"]


def test_a_resumed_compiled_run_is_the_run_that_was_never_stopped(tmp_path, monkeypatch):
    start = partial(train, "q_learning", "FrozenLake-v1", steps=400, seeds=3, num_envs=2, settings={"n_steps": 5}, checkpoint_every=150)
    whole = start(output=tmp_path / "whole")

    def press(self, steps, *rest):
        if steps == 240:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(progress.Progress, "update", press)
    stopped = start(output=tmp_path / "stopped")
    monkeypatch.undo()
    assert stopped.status == "interrupted" == read_run(stopped.run)["status"]
    assert 240 <= stopped.steps < 400
    resumed = resume(stopped.run)
    assert resumed.status == "finished" == read_run(resumed.run)["status"]
    assert logged(resumed.run) == logged(whole.run)
    assert policy_bytes(resumed.run) == policy_bytes(whole.run)


def test_environments_of_a_pool_never_share_a_seed():
    streams = [environment_seeds(seed, range(4), 8, stream) for seed in range(6) for stream in range(6)]
    every = [seed for stream in streams for seed in stream]
    assert len(set(every)) == len(every)
    assert environment_seeds(1, [2], 8, 3) == environment_seeds(1, range(4), 8, 3)[16:24], "agent 2 has its own seeds, alone or not"
    assert all(0 <= seed < 2**31 for seed in every)
