"""Environments by their ids alone: each trains an iteration or two on the engine that is chosen by itself, and is evaluated."""

import importlib.util

import numpy as np
import pytest

from thorndike import api
from thorndike.environments import registry
from thorndike.environments.origins import make_single
from thorndike.errors import UserError

MUJOCO = (
    "Ant-v5",
    "HalfCheetah-v5",
    "Hopper-v5",
    "Humanoid-v5",
    "HumanoidStandup-v5",
    "InvertedDoublePendulum-v5",
    "InvertedPendulum-v5",
    "Pusher-v5",
    "Reacher-v5",
    "Swimmer-v5",
    "Walker2d-v5",
)
BOX2D = ("LunarLander-v3", "LunarLanderContinuous-v3", "BipedalWalker-v3", "BipedalWalkerHardcore-v3", "CarRacing-v3")
MINIGRID = ("MiniGrid-Empty-5x5-v0", "MiniGrid-DoorKey-5x5-v0", "MiniGrid-FourRooms-v0")
PROCGEN = ("CoinrunEasy-v0", "StarpilotEasy-v0")
ATARI = ("ALE/Pong-v5", "ALE/Breakout-v5")
CHEAP = ("InvertedPendulum-v5", "MiniGrid-Empty-5x5-v0")
PACKAGES = {MUJOCO: "mujoco", BOX2D: "Box2D", MINIGRID: "envpool", PROCGEN: "envpool", ATARI: "ale_py"}
CASES = [
    pytest.param(
        id,
        marks=[
            *([] if id in CHEAP else [pytest.mark.slow]),
            pytest.mark.skipif(importlib.util.find_spec(package) is None, reason=f"{package} is not installed"),
        ],
    )
    for ids, package in PACKAGES.items()
    for id in ids
]


@pytest.mark.parametrize("id", CASES)
def test_an_id_trains_and_is_evaluated(id, tmp_path):
    settings = {"n_steps": 16, "batch_size": 32, "n_epochs": 1, "net_arch": (8,)}
    try:
        result = api.train("ppo", id, steps=64, num_envs=2, settings=settings, preset="none", output=tmp_path, max_episode_steps=12)
    except UserError as error:
        if "Qt" in str(error):
            pytest.skip("EnvPool's Procgen needs the system's Qt 5")
        raise
    found = api.load(result.run).evaluate(episodes=2, num_envs=2)
    assert result.steps == 64 and np.isfinite(found.mean) and found.episodes == 2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("algorithm", "preset", "cnn"), [("dqn", "default", "nature"), ("dqn", "classic", "impala"), ("ppo", "classic", "impala")]
)
def test_atari_trains_with_the_papers_presets(algorithm, preset, cnn, tmp_path):
    pytest.importorskip("ale_py")
    small = {"dqn": {"buffer_size": 400, "learning_starts": 32}, "ppo": {"n_steps": 8, "batch_size": 16}}[algorithm]
    settings = {**small, "cnn": cnn, "net_arch": (8,)}
    result = api.train(algorithm, "ALE/Breakout-v5", steps=64, num_envs=2, preset=preset, settings=settings, output=tmp_path)
    policy = api.load(result.run)
    assert policy.protocol.startswith("classic" if preset == "classic" else "machado")
    assert policy.facts["env_kwargs"] == ({"protocol": "classic"} if preset == "classic" else {})
    assert [part["name"] for part in policy.facts["wrappers"]] == ["clip_reward", "end_at_cost"][: 1 + (preset == "classic")]


@pytest.mark.parametrize(
    ("id", "missing", "words"),
    [
        ("ALE/Pong-v5", "ale_py", r"pip install 'thorndike\[atari\]'"),
        ("MiniGrid-DoorKey-5x5-v0", "envpool", r"pip install 'thorndike\[pool\]'"),
        ("CoinrunEasy-v0", "envpool", r"pip install 'thorndike\[pool\]'"),
        ("CarRacing-v3", "Box2D", r"pip install 'thorndike\[box2d\]'"),
        ("Walker2d-v5", "mujoco", r"pip install 'thorndike\[mujoco\]'"),
    ],
)
def test_a_package_that_is_missing_is_named_with_its_extra(id, missing, words, monkeypatch):
    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *more: None if name == missing else found(name, *more))
    registered = registry._gymnasium_has
    monkeypatch.setattr(registry, "_gymnasium_has", lambda name: not name.startswith("ALE/") and registered(name))
    with pytest.raises(UserError, match=words):
        registry.resolve(id, engine="gymnasium" if missing in ("mujoco", "Box2D") else "auto")
        make_single(id, {})
