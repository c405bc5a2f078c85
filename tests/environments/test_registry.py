import json
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import SyncVectorEnv
from gymnasium.wrappers import TransformObservation

from environments.counting_environments import CountingEnv, WideBoxEnv
from thorndike.environments.host.envpool_ids import pool_is_installed
from thorndike.environments.native import NATIVE, factory
from thorndike.environments.native.vectorize import vectorize
from thorndike.environments.registry import build_host, build_native, environment_ids, reference, resolve
from thorndike.errors import UserError
from thorndike.games.registry import game_ids

FILE = Path(__file__).parent / "counting_environments.py"
needs_pool = pytest.mark.skipif(not pool_is_installed(), reason="EnvPool is not installed")


@pytest.mark.parametrize(
    ("id", "engine"),
    [
        ("CartPole-v1", "native"),
        ("probe/TimeLimit-v0", "native"),
        ("FrozenLake-v1", "native"),
        ("CliffWalking-v1", "native"),
        ("Taxi-v4", "native"),
        pytest.param("LunarLander-v3", "envpool", marks=needs_pool),
        pytest.param("HalfCheetah-v5", "envpool", marks=needs_pool),
        pytest.param("MiniGrid-DoorKey-5x5-v0", "envpool", marks=needs_pool),
        ("CarRacing-v3", "gymnasium"),
        ("gymnasium.envs:CartPole-v0", "gymnasium"),
        (f"{FILE}:CountingEnv", "gymnasium"),
        ("environments.counting_environments:CountingEnv", "gymnasium"),
    ],
)
def test_an_id_gets_its_fastest_engine(id, engine):
    choice = resolve(id)
    assert (choice.engine, choice.id) == (engine, id)


@pytest.mark.parametrize("engine", ["native", "gymnasium", "subprocess", pytest.param("envpool", marks=needs_pool)])
def test_an_engine_that_is_asked_for_is_taken(engine):
    assert resolve("CartPole-v1", engine=engine).engine == engine


def test_settings_that_no_native_factory_takes_go_to_gymnasium():
    assert resolve("CartPole-v1", env_kwargs={"sutton_barto_reward": True}).engine == "native"
    assert resolve("Pendulum-v1", env_kwargs={"render_mode": "rgb_array"}).engine == "gymnasium"
    assert resolve("LunarLander-v3", env_kwargs={"gravity": -5.0}).engine == "gymnasium"


def test_a_wrong_id_is_one_line_with_the_nearest_and_imports_no_jax():
    code = (
        "import json, sys\n"
        "from thorndike.environments.registry import resolve\n"
        "from thorndike.errors import UserError\n"
        "try: resolve('CartPol-v1')\n"
        "except UserError as error: print(json.dumps([str(error), 'jax' in sys.modules]))\n"
    )
    source = Path(__file__).parents[2] / "src"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env={"PYTHONPATH": str(source)}, check=True)
    message, jax_imported = json.loads(done.stdout)
    assert message == "unknown environment 'CartPol-v1'; did you mean 'CartPole-v1'?"
    assert not jax_imported


@pytest.mark.parametrize(
    ("request_", "words"),
    [
        (lambda: resolve("Walker3d-v5"), "did you mean 'Walker2d-v5'"),
        (lambda: resolve("xyzzy"), "path/to/file.py:ClassName"),
        (lambda: resolve("CartPole-v1", engine="envpol"), "did you mean 'envpool'"),
        (lambda: resolve("MountainCar-v1", engine="envpool"), "did you mean 'MountainCar-v0'"),
        (lambda: resolve("CarRacing-v3", engine="native"), "no native engine"),
        (lambda: resolve("CartPole-v1", max_episode_steps=0), "at least 1, not 0"),
        (lambda: resolve("no_such_module:Thing-v0"), "cannot import no_such_module"),
        (lambda: resolve("missing.py:Thing"), "no file missing.py"),
        (lambda: resolve(f"{FILE}:CountinEnv"), "did you mean 'CountingEnv'"),
        (lambda: resolve(f"{FILE}:length_of"), "cannot be made with no settings"),
        (lambda: resolve("FrozenLake-v1", env_kwargs={"mapp": 1}), "Gymnasium cannot make FrozenLake-v1"),
        (lambda: resolve(42), "not 42"),
        (lambda: resolve(dict), "must give a gymnasium.Env, not dict"),
        (lambda: resolve(WideBoxEnv(), env_kwargs={"a": 1}), "made already"),
        (lambda: build_host(resolve("CartPole-v1"), 1), "build_native"),
        (lambda: build_native(resolve(CountingEnv), 1), "build_host"),
        (lambda: reference(resolve("probe/Counting-v0"), "rgb_array"), "no picture"),
    ],
)
def test_a_mistake_is_one_line_that_says_how_to_mend_it(request_, words):
    with pytest.raises(UserError) as caught:
        request_()
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_table_is_read_with_the_settings_given():
    choice = resolve("FrozenLake-v1", env_kwargs={"map_name": "8x8", "is_slippery": False}, max_episode_steps=30)
    environment = build_native(choice, 3)
    assert environment.spec.observation_space.n == 64
    assert environment.spec.max_episode_steps == 30
    assert reference(choice).observation_space.n == 64


def test_a_table_behind_another_wrapper_is_not_taken_for_the_environment():
    space = gymnasium.spaces.Box(0, 15, (1,))
    wrapped = TransformObservation(gymnasium.make("FrozenLake-v1"), lambda obs: np.array([obs], np.float32), space)
    assert resolve(wrapped).engine == "gymnasium"
    assert resolve(gymnasium.make("FrozenLake-v1")).engine == "native"


@pytest.mark.parametrize(
    "environment",
    [f"{FILE}:CountingEnv", CountingEnv, lambda: CountingEnv(), CountingEnv()],
    ids=["path", "class", "function", "object"],
)
def test_a_users_own_environment_runs_with_a_limit_and_its_reference_is_fresh(environment):
    choice = resolve(environment, max_episode_steps=1)
    engine = build_host(choice, 2)
    obs = engine.reset([4, 5])
    assert engine.spec.max_episode_steps == 1 and obs.shape == (2, 2)
    step = engine.step(np.zeros(2, np.int32))
    assert step.truncated.all()
    one = reference(choice)
    assert one.reset(seed=2)[0][1] == 0
    assert one.step(0)[3]
    assert reference(choice) is not one


def test_an_object_is_copied_and_never_stepped():
    mine = CountingEnv()
    mine.reset(seed=3)
    engine = build_host(resolve(mine), 2)
    engine.reset([0, 1])
    engine.step(np.zeros(2, np.int32))
    assert mine.count == 0


def test_settings_reach_a_users_class():
    choice = resolve(f"{FILE}:CountingEnv", env_kwargs={"longest": 1})
    engine = build_host(choice, 1)
    engine.reset([1])
    step = engine.step(np.zeros(1, np.int32))
    assert bool((step.terminated | step.truncated)[0])
    assert reference(choice).unwrapped.longest == 1


def test_a_users_vector_is_taken_as_it_is():
    vector = SyncVectorEnv([CountingEnv] * 3)
    choice = resolve(vector)
    assert choice.engine == "gymnasium"
    assert build_host(choice, 3).reset([0, 1, 2]).shape == (3, 2)
    assert isinstance(reference(choice), CountingEnv)
    with pytest.raises(UserError, match="a vector of 3 environments, not 4"):
        build_host(choice, 4)


def test_native_objects_are_taken_as_they_are():
    dynamics = factory("CartPole-v1")()
    environment = vectorize(dynamics, 2)
    assert build_native(resolve(environment), 2) is environment
    assert build_native(resolve(dynamics, max_episode_steps=9), 5).spec[3:5] == (5, 9)
    with pytest.raises(UserError, match="2 environments, not 3"):
        build_native(resolve(environment), 3)


def test_a_native_id_keeps_gymnasiums_environment_as_its_reference():
    choice = resolve("CartPole-v1", max_episode_steps=7)
    assert build_native(choice, 4).spec.max_episode_steps == 7
    one = reference(choice, "rgb_array")
    one.reset(seed=0)
    assert one.render().shape == (400, 600, 3)
    assert one.spec.max_episode_steps == 7


def test_a_probe_is_its_own_reference():
    one = reference(resolve("probe/TimeLimit-v0"))
    one.reset(seed=0)
    steps = [one.step(0) for _ in range(10)]
    assert [step[3] for step in steps] == [False] * 9 + [True]
    assert not any(step[2] for step in steps)
    assert one.observation_space.contains(steps[0][0])


@needs_pool
def test_an_id_of_the_pool_alone_is_its_own_reference():
    choice = resolve("MiniGrid-Empty-5x5-v0", max_episode_steps=6)
    one = reference(choice, "rgb_array")
    obs, _ = one.reset(seed=0)
    assert obs["image"].shape == (7, 7, 3)
    assert [one.step(0)[3] for _ in range(6)] == [False] * 5 + [True]
    assert one.render().ndim == 3
    np.testing.assert_array_equal(one.reset(seed=1)[0]["image"], one.reset(seed=1)[0]["image"])


@needs_pool
def test_a_shared_id_of_the_pool_shows_gymnasiums_spaces_and_limit():
    engine = build_host(resolve("LunarLander-v3", max_episode_steps=4), 2)
    one = gymnasium.make("LunarLander-v3")
    assert engine.spec.observation_space == one.observation_space
    engine.reset([0, 1])
    flags = [engine.step(np.zeros(2, np.int32)).truncated.tolist() for _ in range(9)]
    assert flags == ([[False] * 2] * 3 + [[True] * 2]) * 2 + [[False] * 2]


def test_every_listed_id_resolves_to_its_engine():
    listed = environment_ids()
    assert listed["native"] == sorted({*NATIVE, *game_ids()})
    assert "FrozenLake-v1" in listed["gymnasium"]
    assert not set(listed["native"]) & set(listed["gymnasium"])
    for engine in ("native", "envpool"):
        for id in listed[engine][::100]:
            assert resolve(id).engine == engine
