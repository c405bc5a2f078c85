"""Recurrent memory: what a feed-forward policy cannot know, a GRU or LSTM learns, in every learner that takes one."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from algorithms.small_environments import recall
from thorndike.algorithms import a2c, a3c, dqn, impala, ppo, reinforce, trpo
from thorndike.environments import wrappers
from thorndike.environments.native.vectorize import vectorize
from thorndike.errors import UserError
from thorndike.functional.action_distributions import action_distribution
from thorndike.networks.heads import Shape, policy_network
from thorndike.training.runner import runner
from thorndike.training.sources import compiled_source

NUM_ENVS, SEEDS = 16, 3
PPO = ppo.Config(total_steps=1, n_steps=16, batch_size=128, n_epochs=4, learning_rate=3e-3, net_arch=(16,), memory="gru", memory_size=16)
A2C = a2c.Config(total_steps=1, n_steps=8, learning_rate=3e-3, net_arch=(16,), memory="lstm", memory_size=16)
A3C = a3c.Config(total_steps=1, n_steps=8, learning_rate=3e-3, net_arch=(16,), memory="lstm", memory_size=16)
IMPALA = impala.Config(total_steps=1, n_steps=8, learning_rate=3e-3, net_arch=(16,), memory="gru", memory_size=16)
TRPO = trpo.Config(total_steps=1, n_steps=16, batch_size=128, learning_rate=3e-3, net_arch=(16,), memory="gru", memory_size=16)
REINFORCE = reinforce.Config(total_steps=1, n_steps=8, learning_rate=1e-2, net_arch=(16,), memory="gru", memory_size=16)
DQN = dqn.Config(
    total_steps=1,
    learning_rate=3e-3,
    buffer_size=8_000,
    learning_starts=500,
    train_freq=64,
    gradient_steps=4,
    batch_size=128,
    sequence_length=8,
    target_update_interval=256,
    exploration_final_eps=0.1,
    exploration_fraction=0.3,
    net_arch=(16,),
    memory="gru",
    memory_size=16,
)


def greedy_return(build, config, iterations: int, rounds: int = 25) -> np.ndarray:
    """Mean return of each seed's greedy policy over whole episodes."""
    environment = vectorize(recall(), NUM_ENVS)
    config = dataclasses.replace(config, total_steps=iterations * getattr(config, "n_steps", 4) * NUM_ENVS)
    algorithm = build(config, environment.spec)
    bound = runner(algorithm, compiled_source(environment, algorithm, wrappers.chain()), 0, range(SEEDS))
    carry, _ = bound.advance(bound.init(), 0, iterations)

    def play(learner, key):
        state, obs = environment.init(key)
        noise = environment.draw(key, 4 * rounds)
        actor = algorithm.actor(learner)

        def one(carry, noise):
            state, obs, memory = carry
            memory, action, _ = algorithm.greedy(actor, memory, obs, ())
            state, step = environment.step(state, action, noise)
            fresh = algorithm.memory(NUM_ENVS)
            memory = jax.tree.map(lambda new, old: jnp.where(step.done[:, None], new, old), fresh, memory)
            return (state, step.obs, memory), step.reward

        _, rewards = jax.lax.scan(one, (state, obs, algorithm.memory(NUM_ENVS)), noise)
        return rewards.sum() / (rounds * NUM_ENVS)

    return np.asarray(jax.jit(jax.vmap(play))(carry.learner, jax.random.split(jax.random.key(5), SEEDS)))


@pytest.mark.parametrize(
    ("build", "config", "iterations"),
    [
        (ppo.ppo, PPO, 80),
        (dqn.dqn, DQN, 400),
        pytest.param(a2c.a2c, A2C, 500, marks=pytest.mark.slow),
        pytest.param(a3c.a3c, A3C, 500, marks=pytest.mark.slow),
        pytest.param(impala.impala, IMPALA, 500, marks=pytest.mark.slow),
        pytest.param(trpo.trpo, TRPO, 80, marks=pytest.mark.slow),
        pytest.param(reinforce.reinforce, REINFORCE, 400, marks=pytest.mark.slow),
    ],
    ids=["ppo gru", "dqn gru", "a2c lstm", "a3c lstm", "impala gru", "trpo gru", "reinforce gru"],
)
def test_a_learner_with_memory_recalls_what_it_saw_at_the_beginning(build, config, iterations, quick_compile):
    assert (greedy_return(build, config, iterations) >= 0.95).all()


def test_without_memory_nothing_is_recalled(quick_compile):
    assert (np.abs(greedy_return(ppo.ppo, dataclasses.replace(PPO, memory="none"), 60)) <= 0.3).all()


def test_dqn_with_memory_takes_single_steps_only():
    with pytest.raises(UserError, match="n_step to 1"):
        dqn.dqn(dataclasses.replace(DQN, n_step=3), vectorize(recall(), 4).spec)


def test_minibatches_of_ppo_with_memory_are_whole_sequences():
    with pytest.raises(UserError, match="do not divide"):
        ppo.ppo(dataclasses.replace(PPO, batch_size=16 * 5), vectorize(recall(), NUM_ENVS).spec)


@pytest.mark.parametrize("kind", ["gru", "lstm"])
def test_a_new_episode_within_a_sequence_starts_from_a_fresh_memory(kind):
    environment = vectorize(recall(), 2)
    network = policy_network(environment.spec, action_distribution(environment.spec.action_space), Shape((8,), "tanh", kind, 8), 0.0)
    obs = jax.random.normal(jax.random.key(0), (6, 2, 2))
    params = network.init(jax.random.key(1), obs[0])
    recurrence = network.recurrence
    begins = jnp.array([[False, False], [False, False], [True, False], [False, False], [False, True], [False, False]])
    memory = jax.tree.map(lambda x: x + 0.5, recurrence.fresh(2))
    memories, (parameters, value) = recurrence.unroll(params, memory, obs, begins)
    step = jax.jit(recurrence.step)
    for t in range(6):
        memory = jax.tree.map(lambda old, t=t: jnp.where(begins[t][:, None], 0.0, old), memory)
        memory, (expected, expected_value) = step(params, memory, obs[t])
        np.testing.assert_allclose(parameters[t], expected, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(value[t], expected_value, rtol=1e-5, atol=1e-6)
        jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-6), jax.tree.map(lambda x, t=t: x[t], memories), memory)
