"""Learning from a dataset: what is drawn, what bootstraps, and that it is one run like any other."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from made_up_data import BOX, made_up
from thorndike.algorithms import bc, cql, td3_bc
from thorndike.environments.probes import TIME_LIMIT
from thorndike.functional.exploration import epsilon_greedy, epsilon_greedy_probabilities
from thorndike.replay.offline import minibatches_of
from thorndike.training.dataset_source import dataset_source, dataset_spec, whole_dataset
from thorndike.training.runner import runner
from thorndike.training.sources import from_environment, to_environment

SMALL = {"total_steps": 400, "batch_size": 32, "net_arch": (8,), "learning_rate": 1e-2}


def source_of(data, **settings):
    algorithm = bc.bc(bc.Config(**SMALL | settings), dataset_spec(data))
    return dataset_source(data, algorithm), algorithm


def test_every_step_is_drawn_about_equally_often_and_its_parts_stay_together():
    data = made_up(BOX)
    source, algorithm = source_of(data, batch_size=400)
    noise = jax.tree.map(lambda x: x[0], source.draw(jax.random.key(0), 1))
    state, rollout, episodes = jax.jit(source.collect)((), (), noise)
    assert (state, rollout.step.reward.shape) == ((), (algorithm.needs.rollout_length, 400))
    assert float(episodes.steps) == algorithm.needs.rollout_length
    rows = np.argmax(np.asarray(rollout.step.reward)[..., None] == data.reward, axis=-1).ravel()
    counts = np.bincount(rows, minlength=16)
    assert (np.abs(counts - counts.mean()) < 6 * counts.mean() ** 0.5).all()
    np.testing.assert_array_equal(np.asarray(rollout.obs).reshape(-1, 3), data.obs[rows])
    np.testing.assert_array_equal(np.asarray(rollout.step.next_obs).reshape(-1, 3), data.next_obs[rows])
    np.testing.assert_allclose(to_environment(BOX, rollout.action).reshape(-1, 1), data.action[rows], atol=1e-6)


def test_box_actions_reach_the_learner_within_one():
    ends = np.array([[-2.0], [0.0], [2.0]], np.float32)
    np.testing.assert_array_equal(from_environment(BOX, ends), [[-1.0], [0.0], [1.0]])


def test_a_step_cut_by_a_limit_bootstraps_and_one_that_terminated_does_not():
    data = made_up(lengths=(2, 2))
    rollout = jax.tree.map(lambda x: jnp.asarray(x)[:, None], whole_dataset(data))
    batches = minibatches_of(rollout, 0.9)
    np.testing.assert_allclose(batches.discount[:, 0], [0.9, 0.0, 0.9, 0.9], rtol=1e-6)


def timed(seed=0):
    """Reward 1 a step, cut after ``TIME_LIMIT`` steps: worth 10 with gamma 0.9, whatever is done."""
    data = made_up(lengths=(TIME_LIMIT,) * 20, seed=seed)
    total = len(data.reward)
    ends = np.arange(total) % TIME_LIMIT == TIME_LIMIT - 1
    zeros = np.zeros((total, 3), np.float32)
    return data._replace(obs=zeros, next_obs=zeros, reward=np.ones(total, np.float32), terminated=np.zeros(total, bool), truncated=ends)


def test_time_limits_are_no_ends_in_a_dataset(quick_compile):
    """Treated as one, the value would be below 7."""
    data = timed()
    config = cql.Config(total_steps=2_000, batch_size=32, net_arch=(16,), learning_rate="linear(0.02, 0)", tau=0.05, gamma=0.9, alpha=0.0)
    algorithm = cql.cql(config, dataset_spec(data))
    bound = runner(algorithm, dataset_source(data, algorithm), 0, range(3))
    carry, _ = bound.advance(bound.init(), 0, 200)
    values = jax.vmap(lambda learner: algorithm.value(algorithm.actor(learner), jnp.zeros((1, 3))))(carry.learner)
    np.testing.assert_allclose(values, 10.0, atol=0.5)


def test_conservatism_lowers_what_the_data_do_not_hold(quick_compile):
    """Action 1 is never taken: plain Q-learning believes what the network says of it, CQL puts it below."""
    data = timed()._replace(action=np.zeros(200, np.int32))
    gaps = {}
    for alpha in (0.0, 1.0):
        config = cql.Config(total_steps=400, batch_size=32, net_arch=(16,), learning_rate=0.01, tau=0.05, gamma=0.9, alpha=alpha)
        algorithm = cql.cql(config, dataset_spec(data))
        bound = runner(algorithm, dataset_source(data, algorithm), 0, range(2))
        _, report = bound.advance(bound.init(), 0, 40)
        gaps[alpha] = np.asarray(report.metrics["train/conservative_gap"])
    assert (gaps[1.0] < gaps[0.0]).all()


@pytest.mark.parametrize("epsilon", [0.0, 0.3, 1.0])
def test_epsilon_greedy_chooses_as_often_as_its_probabilities_say(epsilon):
    q, allowed = jnp.asarray([[1.0, 3.0, 3.0, 2.0]]), jnp.asarray([[True, True, True, False]])
    uniform = (jnp.arange(20_000) + 0.5) / 20_000
    for mask in (None, allowed):
        wide = None if mask is None else jnp.broadcast_to(mask, (20_000, 4))
        chosen = epsilon_greedy(
            jnp.broadcast_to(q, (20_000, 4)), jnp.full(20_000, epsilon), uniform, random_ties=False, allowed=wide
        ).action
        counted = np.bincount(np.asarray(chosen), minlength=4) / 20_000
        np.testing.assert_allclose(epsilon_greedy_probabilities(q, jnp.float32(epsilon), mask)[0], counted, atol=1e-3)


def test_the_cloning_term_pulls_the_policy_to_the_actions_of_the_data():
    """With alpha 0 TD3+BC is behaviour cloning; the objective's slope says so."""
    data = made_up(BOX)
    rollout = jax.tree.map(lambda x: jnp.asarray(x)[:, None], whole_dataset(data))
    batch = jax.tree.map(lambda x: x[:, 0], minibatches_of(rollout, 0.9))
    action, q = jnp.zeros_like(batch.action), jnp.ones(16)
    slope = jax.grad(lambda a: td3_bc.cloning_objective(q, a, batch, 0.0))(action)
    np.testing.assert_allclose(slope, 2 * (action - batch.action) / 16, rtol=1e-5)
    with_values = td3_bc.cloning_objective(q * 4.0, action, batch, 2.5)
    np.testing.assert_allclose(with_values, np.mean(np.square(np.asarray(batch.action))) - 2.5, rtol=1e-5)
