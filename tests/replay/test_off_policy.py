"""What the learners of continuous control share."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from thorndike.algorithms import sac
from thorndike.environments import wrappers
from thorndike.environments.native import factory
from thorndike.environments.native.vectorize import vectorize
from thorndike.training import runner as runner_module
from thorndike.training.runner import runner
from thorndike.training.sources import compiled_source
from thorndike.types import Rollout, Step

RING = 12_347
CONFIG = sac.Config(total_steps=1000, learning_starts=10, batch_size=8, net_arch=(8,), buffer_size=RING)


@pytest.fixture(scope="module")
def pendulum():
    environment = vectorize(factory("Pendulum-v1")(), 1)
    return environment, sac.sac(CONFIG, environment.spec)


def test_actions_are_uniform_before_learning_starts_and_the_policys_after(pendulum):
    _, algorithm = pendulum
    state = algorithm.init(jax.random.key(0))
    noise = algorithm.draw(jax.random.key(1), 4000)[:, 0]
    obs = jnp.zeros((4000, 3))
    _, early, _ = algorithm.act(algorithm.actor(state), (), obs, noise)
    quarters = np.histogram(np.asarray(early), bins=4, range=(-1, 1))[0]
    assert (np.abs(quarters - 1000) < 120).all()
    late_actor = algorithm.actor(state._replace(env_steps=jnp.int32(10)))
    assert not bool(late_actor.at_random)
    _, late, _ = algorithm.act(late_actor, (), obs, noise)
    assert not np.allclose(early, late)
    _, best, _ = algorithm.greedy(late_actor, (), obs, noise)
    assert np.ptp(np.asarray(best)) == 0.0
    assert np.abs(np.asarray(late)).max() <= 1.0


def test_no_step_copies_the_replay(pendulum, monkeypatch):
    """One gradient step an iteration is the case that XLA would otherwise pay for with a copy of the ring at every step."""
    environment, algorithm = pendulum
    programs, compile_segment = [], runner_module.compile_segment

    def watched(lowered):
        programs.append(compile_segment(lowered))
        return programs[-1]

    monkeypatch.setattr(runner_module, "compile_segment", watched)
    bound = runner(algorithm, compiled_source(environment, algorithm, wrappers.chain()), 0, range(1))
    bound.advance(bound.init(), 0, algorithm.needs.warmup_iterations + 2)
    assert len(programs) == 2
    for program in programs:
        assert f"[{RING}," in program.as_text(), "the ring is in the program by this size"
        loops = program.as_text().partition("ENTRY")[0]
        assert not re.findall(rf"= \w+\[{RING}[,\]]\S* copy\(", loops)


def test_an_update_from_a_reward_that_is_no_number_is_not_applied_and_is_reported(pendulum, quick_compile):
    _, algorithm = pendulum

    @jax.jit
    def learn(key, reward):
        state = algorithm.init(key)
        row, flag = jnp.zeros((1, 1)), jnp.zeros((1, 1), bool)
        step = Step(jnp.zeros((1, 1, 3)), jnp.zeros((1, 1, 3)), row + reward, row, flag, flag, ~flag)
        rollout = Rollout(jnp.zeros((1, 1, 3)), jnp.zeros((1, 1, 1)), {}, step, ())
        after, metrics = algorithm.update(state, rollout, key)
        return state.learnt, after.learnt, metrics

    before, after, metrics = learn(jax.random.key(0), jnp.nan)
    jax.tree.map(np.testing.assert_array_equal, before, after)
    assert np.isnan(metrics["train/critic_loss"])
    before, after, metrics = learn(jax.random.key(0), 1.0)
    assert np.isfinite(metrics["train/critic_loss"])
    assert (before.critics.params != after.critics.params).any()
