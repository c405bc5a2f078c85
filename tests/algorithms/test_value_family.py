"""The deep Q-learners as compositions: the same parts give the same bits, resets, and what does not go together."""

from functools import cache

import jax
import numpy as np
import pytest

from algorithms.small_environments import recall
from thorndike.algorithms import bootstrapped_dqn, dqn, iqn, pqn, qr_dqn, rainbow
from thorndike.environments import wrappers
from thorndike.environments.native import factory
from thorndike.environments.native.vectorize import vectorize
from thorndike.errors import UserError
from thorndike.networks.heads import q_values
from thorndike.training.runner import runner
from thorndike.training.sources import compiled_source

NUM_ENVS = 4
CARTPOLE = vectorize(factory("CartPole-v1")(), NUM_ENVS)
COMMON = {
    "total_steps": 400,
    "learning_rate": 1e-3,
    "buffer_size": 120,
    "learning_starts": 40,
    "batch_size": 8,
    "train_freq": 8,
    "gradient_steps": 2,
    "target_update_interval": 16,
    "net_arch": (8, 8),
}


@cache
def learnt(module, iterations: int, settings: tuple = ()):
    """The learner's state after some iterations of 8 steps."""
    name = module.__name__.rpartition(".")[2]
    algorithm = getattr(module, name)(module.Config(**(COMMON | dict(settings))), CARTPOLE.spec)
    bound = runner(algorithm, compiled_source(CARTPOLE, algorithm, wrappers.chain()), 0, [0])
    return jax.tree.map(np.asarray, bound.advance(bound.init(), 0, iterations)[0].learner)


PARTS = {
    "qr_dqn": (qr_dqn, {"n_quantiles": 5}, {"distribution": "quantile", "quantiles": 5}),
    "rainbow": (
        rainbow,
        {"atoms": 11, "prioritized_alpha": 0.5, "adam_eps": 1e-4},
        {"distribution": "c51", "atoms": 11, "prioritized": True, "prioritized_alpha": 0.5, "noisy": True, "double": True, "dueling": True}
        | {"n_step": 3, "adam_eps": 1e-4},
    ),
}


@pytest.mark.parametrize(("module", "own", "parts"), PARTS.values(), ids=PARTS)
def test_a_named_learner_is_dqn_with_these_parts(module, own, parts, quick_compile):
    named, composed = learnt(module, 21, tuple(own.items())), learnt(dqn, 21, tuple(parts.items()))
    np.testing.assert_array_equal(named.params, composed.params)
    assert not np.array_equal(named.params, named.target_params)


def test_priorities_follow_the_errors_of_what_was_drawn(quick_compile):
    replay = learnt(rainbow, 21, tuple(PARTS["rainbow"][1].items())).replay
    leaves = replay.levels[0].ravel()
    stored = leaves[leaves > 0]
    assert len(np.unique(stored)) > 20, "errors differ"
    assert stored.max() <= replay.highest.max() * 1.00001
    np.testing.assert_allclose(replay.levels[-1].sum(), leaves.sum(), rtol=1e-5)


def test_a_reset_renews_the_network_and_its_target_keeps_the_replay_and_leaves_time_to_learn(quick_compile):
    """Of 400 steps a reset comes after 120 and 240; at 360 too few are left."""
    settings = (("reset_every", 120),)
    before, after = learnt(dqn, 29, settings), learnt(dqn, 30, settings)
    assert np.abs(after.params - before.params).mean() > 0.05, "weights of a new network are unlike those that learnt"
    np.testing.assert_array_equal(after.params, after.target_params)
    assert all(not np.any(leaf) for leaf in jax.tree.leaves(after.opt_state))
    assert after.replay.size == before.replay.size
    late, later = learnt(dqn, 44, settings), learnt(dqn, 45, settings)
    assert np.abs(later.params - late.params).max() < 0.05


@pytest.mark.parametrize(
    ("module", "settings", "says"),
    [
        (dqn, {"memory": "gru", "prioritized": True}, "prioritized to false"),
        (dqn, {"memory": "gru", "distribution": "implicit"}, "without memory"),
        (dqn, {"noisy": True, "exploration": "boltzmann"}, "exploration to epsilon"),
        (dqn, {"munchausen": True, "n_step": 3}, "n_step to 1"),
        (iqn, {"munchausen": True, "double": True}, "double to false"),
        (dqn, {"munchausen": True, "distribution": "c51"}, "distribution to quantile"),
        (dqn, {"distribution": "c51", "v_min": 2.0, "v_max": 1.0}, "v_min below v_max"),
        (rainbow, {"v_min": 2.0, "v_max": 2.0}, "below"),
        (dqn, {"buffer_size": 8, "n_step": 20}, "make it larger"),
        (pqn, {"n_steps": 5, "batch_size": 16}, "do not divide"),
    ],
)
def test_parts_that_do_not_go_together_say_so_in_one_line(module, settings, says):
    name = module.__name__.rpartition(".")[2]
    with pytest.raises(UserError, match=says) as refusal:
        getattr(module, name)(module.Config(**settings), CARTPOLE.spec)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("module", [dqn, rainbow, qr_dqn, iqn, pqn, bootstrapped_dqn])
def test_other_actions_than_discrete_are_refused(module):
    pendulum = vectorize(factory("Pendulum-v1")(), NUM_ENVS).spec
    name = module.__name__.rpartition(".")[2]
    with pytest.raises(UserError, match=f"{name} takes Discrete actions"):
        getattr(module, name)(module.Config(), pendulum)


def test_a_network_of_ones_own_is_taken_where_there_is_none_built_in():
    def own(spec, outputs):
        return q_values(spec.observation_space, outputs, (4,), "tanh")

    spec = vectorize(recall(), NUM_ENVS).spec
    for module in (qr_dqn, pqn):
        name = module.__name__.rpartition(".")[2]
        algorithm = getattr(module, name)(module.Config(), spec, own)
        assert jax.eval_shape(algorithm.init, jax.random.key(0)) is not None
    with pytest.raises(UserError, match="own network"):
        iqn.iqn(iqn.Config(), spec, own)
