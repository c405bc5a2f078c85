"""Presets: every one that is shipped can be trained with, and what is asked for by name is found or refused."""

import dataclasses
import importlib

import pytest

from thorndike.algorithms import ALGORITHMS
from thorndike.api.building import build_algorithm, full_config
from thorndike.environments import registry, wrappers
from thorndike.errors import UserError
from thorndike.training.presets import EMPTY, Preset, find_preset, load_presets
from thorndike.types import EnvSpec

SHIPPED = [
    (algorithm, environment, preset)
    for algorithm in ALGORITHMS
    for environment, variants in load_presets(algorithm).items()
    for preset in variants.values()
]


@pytest.mark.parametrize(("algorithm", "environment", "preset"), SHIPPED, ids=[f"{a} {e} {p.name}" for a, e, p in SHIPPED])
def test_a_shipped_preset_builds_its_learner(algorithm: str, environment: str, preset: Preset):
    """Its names, its bounds, its minibatches, its wrappers on its environment's spaces."""
    environment = environment.replace("*", "Pong-v5")
    choice = registry.resolve(environment, env_kwargs=preset.env_kwargs)
    known = {field.name for field in dataclasses.fields(importlib.import_module(ALGORITHMS[algorithm].module).Config)}
    assert set(preset.settings) <= known
    num_envs = preset.num_envs or 1
    if choice.engine == "native":
        spec = registry.build_native(choice, num_envs).spec
    else:
        probe = registry.reference(choice)
        spec = EnvSpec(environment, probe.observation_space, probe.action_space, num_envs)
        probe.close()
    wrapper = wrappers.from_settings(preset.wrappers)
    config = full_config(algorithm, {**preset.settings, "total_steps": preset.steps or 1000})
    built = build_algorithm(algorithm, config, wrapper.spec(spec), None)
    assert built.needs.rollout_length >= 1
    for name, value in preset.settings.items():
        assert config[name] == (tuple(value) if isinstance(value, list) else value)


def test_the_default_preset_is_taken_unasked():
    assert find_preset("ppo", "CartPole-v1") == load_presets("ppo")["CartPole-v1"]["default"]
    assert find_preset("ppo", "CartPole-v1").num_envs == 8


def test_none_and_unknown_environments_have_the_algorithms_defaults():
    assert find_preset("ppo", "CartPole-v1", "none") == EMPTY == find_preset("ppo", "Nobody-v0") == find_preset("nobody", "CartPole-v1")


def test_an_unknown_preset_is_refused_with_those_there_are():
    with pytest.raises(UserError, match="known: default"):
        find_preset("ppo", "CartPole-v1", "tuned")
    with pytest.raises(UserError, match="there are none"):
        find_preset("ppo", "Nobody-v0", "tuned")
