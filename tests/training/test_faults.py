"""A number that is none: the update is not applied, and the first culprit is found again and named."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces

from thorndike.algorithms import a2c, a3c, dqn, impala, ppo, q_learning, reinforce, trpo
from thorndike.environments import wrappers
from thorndike.environments.native.randomness import no_noise
from thorndike.environments.native.vectorize import Dynamics, vectorize
from thorndike.training.faults import first_culprit, locate
from thorndike.training.runner import runner
from thorndike.training.sources import compiled_source

BAD_STEP = 37
NUM_ENVS = 2


def counting(bad: str, whole: bool = False) -> Dynamics:
    """Counts its steps for ever; at step 37 the reward, or the observation that follows, is not a number."""

    def observe(state):
        seen = state[..., None].astype(jnp.float32) / 100.0
        wrong = bad == "observation"
        return state % 8 if whole else jnp.where((state == BAD_STEP + 1)[..., None] & wrong, jnp.inf, seen)

    def step(state, action, noise):
        wrong = (state == BAD_STEP) & (bad == "reward")
        return state + 1, jnp.where(wrong, jnp.nan, 1.0), jnp.zeros_like(state, bool)

    space = spaces.Discrete(8) if whole else spaces.Box(0, 100, (1,), np.float32)
    return Dynamics(lambda noise: jnp.zeros((), jnp.int32), observe, step, no_noise, no_noise, space, spaces.Discrete(2), "counting")


CASES = {
    "ppo": (ppo.ppo, ppo.Config(n_steps=8, batch_size=16, n_epochs=2, net_arch=(8,))),
    "a2c": (a2c.a2c, a2c.Config(net_arch=(8,))),
    "a3c": (a3c.a3c, a3c.Config(net_arch=(8,))),
    "impala": (impala.impala, impala.Config(n_steps=5, net_arch=(8,))),
    "trpo": (trpo.trpo, trpo.Config(n_steps=8, batch_size=16, n_critic_updates=2, net_arch=(8,))),
    "reinforce": (reinforce.reinforce, reinforce.Config(n_steps=8, net_arch=(8,))),
    "dqn": (dqn.dqn, dqn.Config(learning_starts=8, train_freq=8, buffer_size=16, gradient_steps=4, batch_size=32, net_arch=(8,))),
    "q_learning": (q_learning.q_learning, q_learning.Config(total_steps=1000, n_steps=8)),
}


def bind(name: str, bad: str):
    build, config = CASES[name]
    environment = vectorize(counting(bad, whole=name == "q_learning"), NUM_ENVS)
    algorithm = build(dataclasses.replace(config, total_steps=1000), environment.spec)
    return algorithm, runner(algorithm, compiled_source(environment, algorithm, wrappers.chain()), 0, range(2))


SLOW = ("a3c", "impala")
"""Cases whose machinery another one runs too."""


@pytest.mark.parametrize("name", [pytest.param(name, marks=pytest.mark.slow if name in SLOW else ()) for name in CASES])
def test_an_update_from_a_reward_that_is_no_number_is_not_applied_and_is_reported(name, quick_compile):
    algorithm, bound = bind(name, "reward")
    iterations = 2 + BAD_STEP // algorithm.needs.rollout_length
    carry, report = bound.advance(bound.init(), 0, iterations)
    actor = jax.vmap(algorithm.actor)(carry.learner)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(actor)), "what acts stays finite"
    bad = [metric for metric, values in report.metrics.items() if not np.isfinite(values).all()]
    assert any(metric.startswith("train/") for metric in bad), "and the metrics tell"


@pytest.mark.parametrize(("bad", "what"), [("reward", "reward"), ("observation", "next observation")])
def test_the_first_culprit_is_named_with_its_step_and_its_batch_is_written(bad, what, tmp_path, quick_compile):
    _, bound = bind("ppo", bad)
    message = locate(tmp_path, bound, bound.init(), 0, 10)
    assert message is not None
    assert f"the {what} of environment 0 of seed 0 is {'nan' if bad == 'reward' else 'inf'}" in message
    assert f"at step {BAD_STEP * NUM_ENVS}" in message
    iteration = BAD_STEP // 8
    assert (tmp_path / "faults" / f"iteration-{iteration}.safetensors").stat().st_size > 0
    assert bound.inspect is not None
    carry, _ = bound.advance(bound.init(), 0, iteration)
    culprit = first_culprit(bound.inspect(carry, iteration))
    assert culprit is not None
    assert culprit.row == BAD_STEP % 8


def test_a_healthy_stretch_has_no_culprit(tmp_path, quick_compile):
    _, bound = bind("ppo", "nothing")
    assert locate(tmp_path, bound, bound.init(), 0, 3) is None
    assert not (tmp_path / "faults").exists()
