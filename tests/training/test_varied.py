"""Agents that differ in their settings within one program are the agents that each setting alone would give."""

import copy
import importlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from thorndike.environments import registry
from thorndike.environments.wrappers import chain
from thorndike.errors import UserError
from thorndike.training.runner import agent_keys, runner
from thorndike.training.segment import RUN_ONCE
from thorndike.training.sources import compiled_source
from thorndike.training.varied import NotTraceable, find_traced, form_of, numbers_of, outcome_shapes, settle, varied
from thorndike.types import Needs

SMALL = {"net_arch": (8,), "activation": "relu"}


def builder(name, spec, **settings):
    module = importlib.import_module(f"thorndike.algorithms.{name}")
    config = module.Config(**settings)

    def build(given):
        altered = copy.copy(config)
        for field, value in given.items():
            object.__setattr__(altered, field, value)
        return getattr(module, name)(altered, spec)

    return build


def environment(id="CartPole-v1", num_envs=4):
    return registry.build_native(registry.resolve(id), num_envs)


def trained(algorithm, where, agents, iterations, learner=None):
    bound = runner(algorithm, compiled_source(where, algorithm, chain()), 0, agents)
    carry = bound.init()
    carry = carry if learner is None else carry._replace(learner=learner)
    return bound.advance(carry, 0, iterations)


CASES = {
    "ppo": (
        "CartPole-v1",
        {**SMALL, "n_steps": 16, "n_epochs": 2},
        {"learning_rate": 1e-2, "gamma": 0.9, "clip_range": 0.1, "ent_coef": 0.01},
        3,
    ),
    "a2c": ("CartPole-v1", SMALL, {"learning_rate": "linear(1e-2,0)", "gae_lambda": 0.9, "rms_prop_eps": 1e-4}, 5),
    "impala": ("CartPole-v1", {**SMALL, "n_steps": 5}, {"learning_rate": "linear(1e-2,0)", "clip_rho": 0.8, "trace_decay": 0.9}, 5),
    "trpo": ("CartPole-v1", {**SMALL, "n_steps": 16, "batch_size": 16, "n_critic_updates": 2}, {"target_kl": 0.02, "gamma": 0.9}, 3),
    "reinforce": ("CartPole-v1", {**SMALL, "n_steps": 32}, {"learning_rate": 1e-2, "gamma": 0.9, "max_grad_norm": 0.1}, 3),
    "dqn": ("CartPole-v1", {**SMALL, "learning_starts": 16, "buffer_size": 128}, {"learning_rate": 1e-2, "gamma": 0.9, "tau": 0.5}, 30),
    "q_learning": ("FrozenLake-v1", {}, {"learning_rate": 0.5, "gamma": 0.9, "initial_value": 0.2, "exploration_final_eps": 0.2}, 50),
}


@pytest.mark.usefixtures("quick_compile")
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name in ("a2c", "impala", "trpo", "reinforce") else ()) for name in CASES]
)
def test_a_lane_learns_what_an_agent_of_its_settings_learns(name):
    id, fixed, own, iterations = CASES[name]
    where, fixed = environment(id), {**fixed, "total_steps": 1_000}
    build, forms = builder(name, where.spec, **fixed), {setting: form_of(value) for setting, value in own.items()}
    numbers = {setting: numbers_of(value) for setting, value in own.items()}
    other = jax.tree.map(lambda x: x * 0.5, numbers)
    lanes = jax.tree.map(lambda *values: jnp.stack(values), other, numbers, numbers)
    agents = (0, 0, 1)
    keys = agent_keys(0, jnp.asarray(agents, jnp.uint32)).learner
    learner = jax.jit(lambda lanes, keys: settle(build, forms, lanes, keys), compiler_options=RUN_ONCE)(lanes, keys)
    carry, report = trained(varied(build, forms, build({}), numbers), where, agents, iterations, learner)
    expected, told = trained(builder(name, where.spec, **{**fixed, **own})({}), where, (0, 1), iterations)
    for found, alone in zip(jax.tree.leaves(carry.learner.inner), jax.tree.leaves(expected.learner), strict=True):
        np.testing.assert_allclose(np.asarray(found[1:], np.float64), np.asarray(alone, np.float64), rtol=2e-3, atol=2e-4)
    np.testing.assert_allclose(report.episodes.return_sum[1:], told.episodes.return_sum)
    for metric in told.metrics:
        np.testing.assert_allclose(report.metrics[metric][1:], told.metrics[metric], rtol=5e-3, atol=1e-3)
    leaves = [np.asarray(leaf, np.float64) for leaf in jax.tree.leaves(carry.learner.inner)]
    assert any(not np.allclose(leaf[0], leaf[1]) for leaf in leaves), "half of each setting changed nothing"


def test_settings_of_ppo_that_change_no_shape_can_be_traced():
    where = environment()
    numbers = {
        "learning_rate": 3e-4, "n_steps": 16, "batch_size": 64, "n_epochs": 2, "gamma": 0.99, "gae_lambda": 0.95, "clip_range": 0.2,
        "clip_range_vf": 0.2, "ent_coef": 0.0, "vf_coef": 0.5, "max_grad_norm": 0.5, "target_kl": 0.01, "log_std_init": 0.0,
    }  # fmt: skip
    found = find_traced(builder("ppo", where.spec, **SMALL, **numbers), numbers, where.spec)
    assert set(found.structural) == {"n_steps", "batch_size", "n_epochs"}
    assert set(found.traced) == set(numbers) - set(found.structural)


def test_settings_of_dqn_that_change_no_shape_can_be_traced():
    where = environment()
    numbers = {
        "learning_rate": 1e-4, "buffer_size": 128, "learning_starts": 16, "batch_size": 8, "train_freq": 4, "gradient_steps": 1,
        "tau": 1.0, "gamma": 0.99, "max_grad_norm": 10.0, "n_step": 1, "target_update_interval": 100,
    }  # fmt: skip
    found = find_traced(builder("dqn", where.spec, **SMALL, **numbers), numbers, where.spec)
    assert {"learning_rate", "tau", "gamma", "max_grad_norm"} <= set(found.traced)
    assert {"buffer_size", "learning_starts", "batch_size", "train_freq", "gradient_steps", "n_step"} <= set(found.structural)


def test_a_setting_that_chooses_the_program_cannot_be_traced():
    where = environment("FrozenLake-v1")
    numbers = {"learning_rate": "linear(0.5,0.1)", "visits_power": 0.5, "gamma": 0.9}
    found = find_traced(builder("q_learning", where.spec, total_steps=1_000, **numbers), numbers, where.spec)
    assert found.traced == ("learning_rate", "gamma") and "visits_power" in found.structural


def altered(build, change):
    def built(given):
        algorithm = build(given)
        return algorithm._replace(**change(given.get("gamma", 0.99), algorithm))

    return built


@pytest.mark.parametrize(
    "change",
    [
        lambda gamma, algorithm: {"draw": lambda key, steps: gamma * algorithm.draw(key, steps)},
        lambda gamma, algorithm: {"memory": lambda batch: jnp.full((batch,), gamma)},
        lambda gamma, algorithm: {"needs": Needs(5 if isinstance(gamma, float) else gamma, on_policy=True)},
        lambda gamma, algorithm: {"value": lambda actor, obs: jnp.zeros((1 if isinstance(gamma, float) else 2,))},
    ],
    ids=["random numbers", "memory", "needs", "a shape"],
)
def test_what_depends_on_a_setting_but_has_none_makes_it_structural(change):
    where = environment()
    build = altered(builder("a2c", where.spec, **SMALL), change)
    assert "gamma" in find_traced(build, {"gamma": 0.99}, where.spec).structural


def test_what_fails_with_concrete_settings_too_is_raised():
    where = environment()

    def build(given):
        raise UserError("this algorithm cannot be")

    with pytest.raises(UserError, match="cannot be"):
        find_traced(build, {"gamma": 0.99}, where.spec)


def test_settings_that_can_be_traced_one_by_one_but_not_together_are_told():
    where = environment()
    plain = builder("a2c", where.spec, **SMALL)

    def build(given):
        if {"gamma", "ent_coef"} <= set(given):
            raise TypeError("not both")
        return plain(given)

    with pytest.raises(NotTraceable, match="gamma, ent_coef can be traced one by one"):
        find_traced(build, {"gamma": 0.99, "ent_coef": 0.0}, where.spec)


@pytest.mark.parametrize(
    ("value", "form"),
    [
        (1, "whole"),
        (1.0, "number"),
        ("3e-4", "number"),
        ("linear(1,0)", "linear"),
        ("cosine(1,0,0.5)", "cosine"),
        ("tanh", None),
        (True, None),
    ],
)
def test_the_form_of_a_value_says_whether_and_as_what_it_is_a_number(value, form):
    assert form_of(value) == form


def test_shapes_do_not_depend_on_what_is_traced():
    where = environment("FrozenLake-v1")
    build = builder("q_learning", where.spec, total_steps=1_000)
    assert str(outcome_shapes(build, {}, where.spec)) == str(outcome_shapes(build, {"gamma": 0.5}, where.spec))
