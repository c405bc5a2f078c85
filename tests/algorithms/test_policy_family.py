"""What makes TRPO, A3C and IMPALA what they are: a bounded step, gradients of old parameters, actors that are late by so many updates."""

from functools import cache, partial
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from thorndike.algorithms import a2c, a3c, impala, trpo
from thorndike.environments import wrappers
from thorndike.environments.native import factory
from thorndike.environments.native.vectorize import vectorize
from thorndike.functional.action_distributions import action_distribution
from thorndike.functional.parameter_history import newest
from thorndike.functional.policy_divergence import policy_divergence
from thorndike.networks.heads import Shape, policy_network
from thorndike.networks.network import flattened
from thorndike.networks.policy_parameters import reaches_policy
from thorndike.networks.torso import example_observation
from thorndike.training.sources import compiled_source
from thorndike.types import Algorithm

ENVIRONMENT = vectorize(factory("CartPole-v1")(), 4)
SAME = {"total_steps": 1000, "n_steps": 5, "net_arch": (8,), "learning_rate": "linear(0.01, 0)"}


def train(algorithm: Algorithm, iterations: int, environment=ENVIRONMENT) -> list:
    """States before each of so many updates, their rollouts and metrics, and the last state alone."""
    source = compiled_source(environment, algorithm, wrappers.chain())
    learner, state = algorithm.init(jax.random.key(0)), source.init(jax.random.key(1))
    update, collect = jax.jit(algorithm.update), jax.jit(source.collect)
    past: list = []
    for i in range(iterations):
        noise = jax.tree.map(lambda x: x[0], source.draw(jax.random.key(2 + i), 1))
        state, rollout, _ = collect(state, algorithm.actor(learner), noise)
        later, metrics = update(learner, rollout, jax.random.key(100 + i))
        past.append((learner, rollout, metrics))
        learner = later
    return [*past, (learner, None, None)]


@cache
def late(learner, lag: int) -> list:
    """Seven updates of A3C or IMPALA."""
    return train(built(learner, lag), 7)


def built(learner, lag: int) -> Algorithm:
    return getattr(learner, learner.__name__.rpartition(".")[2])(learner.Config(**SAME, policy_lag=lag), ENVIRONMENT.spec)


def flat(params) -> np.ndarray:
    return np.asarray(ravel_pytree(params)[0])


def test_a3c_without_a_lag_is_a2c(quick_compile):
    ours = train(a3c.a3c(a3c.Config(**SAME, policy_lag=0, ent_coef=0.02), ENVIRONMENT.spec), 4)
    theirs = train(a2c.a2c(a2c.Config(**SAME, ent_coef=0.02), ENVIRONMENT.spec), 4)
    for (mine, _, _), (other, _, _) in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(flat(newest(mine.history)), flat(other.params), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(("learner", "lag"), [(a3c, 2), (impala, 3)])
def test_the_actor_is_so_many_updates_old_and_the_first_one_until_then(learner, lag, quick_compile):
    algorithm, past = built(learner, lag), late(learner, lag)
    for i, (state, _, metrics) in enumerate(past):
        played = max(0, i - lag)
        np.testing.assert_array_equal(algorithm.actor(state).params, newest(past[played][0].history))
        assert int(algorithm.actor(state).version) == played
        assert metrics is None or float(metrics["train/policy_lag"]) == i - played
    assert len({flat(newest(state.history)).tobytes() for state, _, _ in past}) == len(past), "every update changes something"


def test_a3c_takes_the_gradient_where_the_rollout_was_played(quick_compile):
    config, past = a3c.Config(**SAME, policy_lag=2), late(a3c, 2)
    distribution = action_distribution(ENVIRONMENT.spec.action_space)
    net = policy_network(ENVIRONMENT.spec, distribution, Shape((8,), "tanh"), 0.0)
    flat_net = flattened(net, example_observation(ENVIRONMENT.spec.observation_space))
    _, rollout, metrics = past[4]
    norms = []
    for version in (2, 4):
        params = newest(past[version][0].history)
        grads, _ = jax.grad(partial(a3c.a3c_loss, network=flat_net, distribution=distribution, config=config), has_aux=True)(
            params, rollout
        )
        norms.append(float(jnp.linalg.norm(grads)))
    assert np.isclose(norms[0], metrics["train/grad_norm"], rtol=1e-4) and not np.isclose(norms[1], norms[0], rtol=1e-3)


def test_impala_corrects_by_the_policy_that_played(quick_compile):
    """Without a lag every weight is 1; with one the learner's policy differs from the one that played, and the metrics say by how much."""
    assert all(float(metrics["train/approx_kl"]) > 1e-6 for _, _, metrics in late(impala, 3)[3:-1])
    assert all(float(metrics["train/approx_kl"]) < 1e-9 for _, _, metrics in train(built(impala, 0), 3)[:-1])


@pytest.mark.parametrize("name", ["CartPole-v1", "Pendulum-v1"])
def test_a_step_of_trpo_keeps_the_bound_and_policy_and_value_apart(name, quick_compile):
    environment = vectorize(factory(name)(), 4)
    spec, bound = environment.spec, 0.02
    config = trpo.Config(n_steps=32, batch_size=32, n_critic_updates=2, net_arch=(8,), target_kl=bound, cg_damping=1e-3)
    past = train(trpo.trpo(config, spec), 4, environment)
    distribution, divergence = action_distribution(spec.action_space), policy_divergence(spec.action_space)
    net = policy_network(spec, distribution, Shape((8,), "tanh"), 0.0)
    mask = reaches_policy(net, example_observation(spec.observation_space))
    accepted = 0
    for (before, rollout, metrics), (after, _, _) in pairwise(past):
        rows = jax.tree.map(lambda x: x.reshape((-1, *x.shape[2:])), rollout.obs)
        old, new = (net.apply(state.params, rows)[0] for state in (before, after))
        measured = float(jnp.mean(divergence(old, new)))
        assert measured <= bound * 1.001
        np.testing.assert_allclose(measured, metrics["train/kl_divergence_loss"], rtol=1e-2, atol=1e-6)
        moved = flat(before.params) != flat(after.params)
        assert moved[~mask].any(), "the value learns"
        assert moved[mask].any() == bool(metrics["train/is_line_search_success"])
        assert not flat(after.opt_state.mu)[mask].any(), "Adam never moves the policy"
        accepted += int(metrics["train/is_line_search_success"])
    assert accepted >= 3


def test_a_step_of_trpo_that_nothing_accepts_is_not_taken():
    spec = ENVIRONMENT.spec
    config = trpo.Config(n_steps=8, batch_size=16, net_arch=(8,), line_search_max_iter=1, cg_damping=0.0, target_kl=100.0)
    past = train(trpo.trpo(config, spec), 1)
    (before, _, metrics), (after, _, _) = past
    mask = reaches_policy(
        policy_network(spec, action_distribution(spec.action_space), Shape((8,), "tanh"), 0.0), example_observation(spec.observation_space)
    )
    assert float(metrics["train/is_line_search_success"]) == 0.0 == float(metrics["train/step_fraction"])
    np.testing.assert_array_equal(flat(before.params)[mask], flat(after.params)[mask])
