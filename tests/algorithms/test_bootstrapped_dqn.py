"""Bootstrapped DQN: its loss against a loop, one member an episode, masks that stay with their transitions, priors that never change."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import thorndike as td
from thorndike.algorithms.bootstrapped_dqn import NOBODY, Config, bootstrap_loss, bootstrapped_dqn
from thorndike.environments.native import factory
from thorndike.environments.native.vectorize import vectorize
from thorndike.environments.wrappers import chain
from thorndike.errors import UserError
from thorndike.networks.ensemble import value_ensemble
from thorndike.networks.heads import Shape
from thorndike.networks.network import Network, Recurrence
from thorndike.replay.uniform import Transitions, sample
from thorndike.training.runner import runner
from thorndike.training.sources import compiled_source

NUM_ENVS, MEMBERS, ROWS = 4, 3, 6
CARTPOLE = vectorize(factory("CartPole-v1")(), NUM_ENVS)
SMALL = Config(
    total_steps=400, buffer_size=120, learning_starts=40, batch_size=8, train_freq=8, gradient_steps=2, n_members=MEMBERS, net_arch=(4,)
)


def batch_of(rng) -> Transitions:
    rows = {"obs": rng.normal(size=(ROWS, 4)), "reward": rng.normal(size=ROWS), "next_obs": rng.normal(size=(ROWS, 4))}
    obs, reward, next_obs = (jnp.asarray(rows[name], jnp.float32) for name in ("obs", "reward", "next_obs"))
    discount, weight = jnp.array([0.9, 0.0, 0.9, 0.9, 0.9, 0.0]), jnp.array([1.0, 1.0, 1.0, 0.0, 1.0, 1.0])
    mask = jnp.asarray(rng.random((ROWS, MEMBERS)) < 0.5).at[:, 0].set(False)
    return Transitions(obs, jnp.asarray(rng.integers(0, 2, ROWS), jnp.int32), reward, next_obs, discount, weight, mask)


@pytest.mark.parametrize("double", [True, False])
def test_the_loss_is_that_of_a_loop_over_members_and_transitions(double):
    ensemble = value_ensemble(CARTPOLE.spec, 2, Shape((4,), "relu"), MEMBERS, 2.0)
    params, targets, priors = (ensemble.init(jax.random.key(i)) for i in range(3))
    batch = batch_of(np.random.default_rng(0))
    loss, metrics = bootstrap_loss(params, targets, priors, batch, ensemble, double)
    q, online_next, target_next = (
        np.asarray(ensemble.values(own, priors, obs), float)
        for own, obs in ((params, batch.obs), (params, batch.next_obs), (targets, batch.next_obs))
    )
    total = 0.0
    for k in range(MEMBERS):
        errors = []
        for m in range(ROWS):
            if batch.mask[m, k] and batch.weight[m]:
                best = (online_next if double else target_next)[k, m].argmax()
                error = abs(q[k, m, batch.action[m]] - float(batch.reward[m]) - float(batch.discount[m]) * target_next[k, m, best])
                errors.append(error**2 / 2 if error <= 1 else error - 0.5)
        total += np.mean(errors) if errors else 0.0
    np.testing.assert_allclose(loss, total, rtol=1e-5)
    np.testing.assert_allclose(metrics["train/loss"], total / MEMBERS, rtol=1e-5)


def test_a_member_is_the_sum_of_its_network_and_its_scaled_prior():
    one, none = (value_ensemble(CARTPOLE.spec, 2, Shape((4,), "relu"), MEMBERS, scale) for scale in (2.0, 0.0))
    params, priors, obs = one.init(jax.random.key(0)), one.init(jax.random.key(1)), jnp.ones((5, 4))
    own, prior = none.values(params, priors, obs), none.values(priors, priors, obs)
    np.testing.assert_allclose(one.values(params, priors, obs), own + 2.0 * prior, rtol=1e-5, atol=1e-6)
    assert len(np.unique(np.asarray(own[:, 0, 0]))) == MEMBERS


def test_an_episode_follows_the_member_drawn_at_its_first_step():
    algorithm = bootstrapped_dqn(SMALL, CARTPOLE.spec)
    actor, obs = algorithm.actor(algorithm.init(jax.random.key(0))), jnp.arange(16.0).reshape(4, 4) / 16
    draws = [jax.tree.map(lambda leaf: leaf[0], algorithm.draw(jax.random.key(i), 1)) for i in range(2)]
    first, second = (draws[i]._replace(member=jnp.array(members)) for i, members in enumerate(([0, 1, 2, 1], [2, 2, 0, 0])))
    memory, action, extras = algorithm.act(actor, algorithm.memory(NUM_ENVS), obs, first)
    np.testing.assert_array_equal(memory, [0, 1, 2, 1])
    values = value_ensemble(CARTPOLE.spec, 2, Shape((4,), "relu"), MEMBERS, SMALL.prior_scale).values(*actor, obs)
    np.testing.assert_array_equal(action, [values[k, b].argmax() for b, k in enumerate([0, 1, 2, 1])])
    np.testing.assert_array_equal(extras["mask"], first.mask)
    later, _, _ = algorithm.act(actor, memory.at[3].set(NOBODY), obs, second)
    np.testing.assert_array_equal(later, [0, 1, 2, 0])
    np.testing.assert_array_equal(algorithm.greedy(actor, memory, obs, ())[1], values.mean(axis=0).argmax(axis=-1))


def test_masks_stay_with_their_transitions_and_priors_as_they_are(quick_compile):
    algorithm = bootstrapped_dqn(SMALL, CARTPOLE.spec)
    bound = runner(algorithm, compiled_source(CARTPOLE, algorithm, chain()), 0, [0])
    priors = np.asarray(bound.init().learner.priors)
    learner = jax.tree.map(lambda leaf: leaf[0], bound.advance(bound.init(), 0, 20)[0].learner)
    np.testing.assert_array_equal(learner.priors, priors[0])
    assert not np.array_equal(learner.held.params, learner.targets)
    rows = learner.replay.rows
    assert 0.3 < np.mean(rows["mask"]) < 0.7
    assert len(np.unique(np.asarray(rows["mask"]), axis=0)) > 4
    drawn = sample(learner.replay, jax.random.key(0), 30, NUM_ENVS, 1, 0.9)
    places = [int(np.flatnonzero((np.asarray(rows["obs"]) == np.asarray(obs)).all(-1))[0]) for obs in drawn.obs]
    np.testing.assert_array_equal(drawn.mask, rows["mask"][np.array(places)])


def test_a_network_with_memory_is_refused():
    def recurrent(spec, outputs):
        nothing = Recurrence(lambda batch: (), lambda params, memory, obs: (memory, obs), lambda params, memory, obs, begins: (memory, obs))
        return Network(lambda key, obs: (), lambda params, obs: obs, nothing)

    with pytest.raises(UserError, match="an ensemble has no memory"):
        bootstrapped_dqn(SMALL, CARTPOLE.spec, recurrent)


@pytest.mark.slow
def test_it_finds_what_lies_ten_right_moves_away(tmp_path):
    """Random actions would need about a thousand episodes to see it once; it has a thousand to see it, believe it and keep to it."""
    result = td.train(
        "bootstrapped_dqn",
        "DeepSea-v0",
        env_kwargs={"size": 10},
        steps=10_000,
        num_envs=1,
        settings={"train_freq": 1, "target_update_interval": 4},
        output=tmp_path,
    )
    assert td.load(result.run).evaluate(episodes=1).mean == pytest.approx(0.99)
