"""Host environments that go wrong: named at the step where it happens, within the time-out, and no process is left."""

import _thread
import json
import os
import random
import signal
import subprocess
import sys
import threading
import time
from functools import partial
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

import thorndike as td
from environments.counting_environments import EPISODES_PER_SEED, CountingEnv, GreedyDiscreteEnv, WideBoxEnv, length_of
from environments.faulty_environments import FaultyEnv, OtherSpaceEnv
from environments.processes import left_of, workers_of
from thorndike.environments.host.faults import Timeouts
from thorndike.environments.host.gymnasium_engine import LoopEngine
from thorndike.environments.host.subprocess_engine import SubprocessEngine
from thorndike.environments.host.vector_engine import VectorEngine
from thorndike.errors import UserError

STEP = 3
"""Where ``FaultyEnv`` does its one thing wrong."""
TIMEOUT = 1.0
CLEAN = 2.0
"""Seconds after the time-out by which all must be over."""
LONGEST = 9
TIMEOUTS = Timeouts(TIMEOUT, TIMEOUT)

WRONG_VALUES = {
    "shape": r"observation\['place'\] of shape \(3,\), but its space says \(2,\)",
    "dtype": r"observation\['picture'\] of dtype float32, but its space says uint8",
    "wide_whole_numbers": r"observation\['picture'\] of dtype int64, but its space says uint8",
    "text": r"observation\['room'\] of dtype <U7",
    "nan": r"nan in observation\['place'\] at \[1\]",
    "infinity": r"-inf in observation\['place'\] at \[0\]",
    "out_of_box": r"10.5 in observation\['place'\] at \[1\], but its space goes from -10.0 to 10.0",
    "out_of_discrete": r"9 in observation\['room'\], but its space goes from 0 to 8",
    "missing_key": r"observation of the keys \['place'\], but its space has the keys \['picture', 'place', 'room'\]",
    "no_dict": "a ndarray for observation, but its space has the keys",
    "nan_reward": "a reward that is nan",
    "huge_reward": "a reward that is inf in float32",
    "row_of_rewards": r"a reward of shape \(1,\)",
    "no_reward": "a reward None",
    "odd_flag": "'no' for terminated",
    "four_values": r"something else than \(observation, reward, terminated, truncated, info\).*got 4",
    "raises": r"raised ZeroDivisionError: by zero \(faulty_environments.py:\d+, in raises\)",
}
WRONG_RESETS = {
    "reset_raises": "raised KeyError: 'door'",
    "reset_shape": r"observation\['place'\] of shape \(1,\), but its space says \(2,\)",
    "reset_nan": r"nan in observation\['place'\] at \[0\]",
    "reset_only_observation": r"something else than \(observation, info\)",
}
DEATHS = {
    "exits": "exited with status 3",
    "sys_exits": "raised SystemExit: enough",
    "dies": r"was killed by signal 9 \(SIGKILL\)",
    "crashes": r"was killed by signal 11 \(SIGSEGV\)",
}
HANGS = ("sleeps", "stops", "hangs_in_native_code", "hangs_and_defends_itself")


def play(engine, steps: int) -> None:
    """Steps with action 0, from the first reset to the fault or the last step."""
    actions = np.zeros(engine.spec.num_envs, np.int32)
    engine.reset(range(engine.spec.num_envs))
    for _ in range(steps):
        engine.step(actions)


def failure(engine, steps: int = 20) -> str:
    with pytest.raises(UserError) as caught:
        play(engine, steps)
    assert "\n" not in str(caught.value)
    return str(caught.value)


# In this process.


@pytest.mark.filterwarnings("ignore:overflow encountered in cast")
@pytest.mark.parametrize("kind", WRONG_VALUES)
def test_a_wrong_value_is_named_with_its_environment_and_step(kind):
    engine = LoopEngine([FaultyEnv, partial(FaultyEnv, kind, STEP)], "mine")
    message = failure(engine)
    assert message.startswith(f"mine, environment 1 of 2, step {STEP}: r")
    with pytest.raises(UserError, match=WRONG_VALUES[kind]):
        raise UserError(message)


@pytest.mark.parametrize("kind", WRONG_RESETS)
def test_a_wrong_reset_is_named_with_the_step_before_it(kind):
    message = failure(LoopEngine([FaultyEnv, partial(FaultyEnv, kind, STEP)], "mine"))
    assert message.startswith("mine, environment 1 of 2, the reset after step 8: r")
    with pytest.raises(UserError, match=WRONG_RESETS[kind]):
        raise UserError(message)
    assert "environment 0 of 1, the first reset: r" in failure(LoopEngine([partial(FaultyEnv, kind, 0)], "mine"))


def test_faults_behind_gymnasiums_wrappers_are_the_same():
    make = partial(gymnasium.wrappers.TimeLimit, max_episode_steps=100)
    engine = LoopEngine([lambda: make(FaultyEnv("four_values", STEP))], "mine")
    assert f"step {STEP}: returned something else than (observation, reward, terminated" in failure(engine)


@pytest.mark.parametrize("kind", ["nan", "nan_reward", "shape", "out_of_discrete"])
def test_late_faults_are_found_at_once(kind):
    assert "step 1234: " in failure(LoopEngine([partial(FaultyEnv, kind, 1234)], "mine"), 1300)


def test_late_values_out_of_bounds_are_found_in_every_hundredth_step():
    assert "step 1300: " in failure(LoopEngine([partial(FaultyEnv, "out_of_box", 1300)], "mine"), 1400)
    play(LoopEngine([partial(FaultyEnv, "out_of_box", 1301)], "mine"), 1400)


def test_float64_for_float32_and_lists_for_arrays_are_no_faults():
    class Loose(WideBoxEnv):
        def reset(self, *, seed=None, options=None):
            return [0.5], {}

        def step(self, action):
            return np.full(1, 0.25), np.float64(1), np.bool_(False), 0, {}

    engine = LoopEngine([Loose], "loose")
    np.testing.assert_array_equal(engine.reset([0]), np.full((1, 1), 0.5, np.float32))
    assert engine.step(np.zeros((1, 1), np.float32)).next_obs.dtype == np.float32


def test_lunar_landers_own_bounds_are_not_held_against_it():
    pytest.importorskip("Box2D")
    env = gymnasium.make("LunarLander-v3", disable_env_checker=True)
    engine, outside = LoopEngine([lambda: env], "LunarLander-v3"), 0
    engine.reset([0])
    for t in range(900):
        obs = engine.step(np.full(1, 1 + t // 300, np.int32)).next_obs[0]
        outside += not env.observation_space.contains(obs)
    assert outside > 0


# A vector of the user's own.


@pytest.mark.parametrize("mode", AutoresetMode)
@pytest.mark.parametrize("kind", ["nan", "out_of_box", "out_of_discrete"])
def test_a_vectors_faults_are_named(kind, mode):
    vector = SyncVectorEnv([FaultyEnv, partial(FaultyEnv, kind, STEP)], autoreset_mode=mode)
    message = failure(VectorEngine(vector, "mine"))
    assert message.startswith(f"mine, environment 1 of 2, step {STEP}: returned")
    with pytest.raises(UserError, match=WRONG_VALUES[kind]):
        raise UserError(message)


def test_a_vectors_rewards_are_one_an_environment():
    class Narrow(SyncVectorEnv):
        def step(self, actions):
            observations, rewards, *rest = super().step(actions)
            return observations, rewards[:1], *rest

    assert "one of 2 environments, step 1: returned rewards of shape (1,)" in failure(VectorEngine(Narrow([FaultyEnv] * 2), "mine"))


@pytest.mark.parametrize(
    ("kind", "words"),
    [("dies", "was killed by signal 9"), ("sleeps", "no answer within 1 s"), ("raises", "raised ZeroDivisionError: by zero")],
)
def test_gymnasiums_own_processes_are_named_and_ended(kind, words):
    vector = AsyncVectorEnv([FaultyEnv, partial(FaultyEnv, kind, STEP)], context="spawn")
    pids = [process.pid for process in vector.processes]
    message = failure(VectorEngine(vector, "mine", timeouts=TIMEOUTS))
    assert message.startswith(f"mine, environment 1 of 2, step {STEP}: ") and words in message
    assert not any(process.is_alive() for process in vector.processes) and all(pids)


# EnvPool.


@pytest.mark.parametrize(("row", "words"), [(0, "returned nan in observation at [2]"), (1, "returned a reward that is inf")])
def test_a_pools_faults_are_named(row, words, monkeypatch):
    envpool = pytest.importorskip("envpool")
    from thorndike.environments.host.envpool_engine import EnvPoolEngine

    make = envpool.make_gymnasium

    class Broken:
        def __init__(self, *args, **settings):
            self.pool, self.steps = make(*args, **settings), 0

        def reset(self, *args):
            return self.pool.reset(*args)

        def step(self, actions):
            obs, reward, *rest = self.pool.step(actions)
            self.steps += 1
            if self.steps == STEP:
                obs, reward = obs.copy(), reward.copy()
                obs[(0, 2) if row == 0 else ()] *= np.nan if row == 0 else 1
                reward[row] *= np.inf
            return obs, reward, *rest

    monkeypatch.setattr(envpool, "make_gymnasium", Broken)
    assert f"CartPole-v1, environment {row} of 2, step {STEP}: {words}" in failure(EnvPoolEngine("CartPole-v1", 2))


# Processes.


@pytest.mark.parametrize("kind", ["shape", "nan_reward", "raises", *DEATHS])
def test_a_workers_fault_is_named_and_no_process_is_left(kind):
    engine = SubprocessEngine([FaultyEnv, partial(FaultyEnv, kind, STEP)], "mine")
    groups, began = workers_of(), time.monotonic()
    assert len(groups) == 2
    message = failure(engine)
    assert time.monotonic() - began < CLEAN
    assert message.startswith(f"mine, worker 1 of 2, step {STEP}: ")
    with pytest.raises(UserError, match=({**WRONG_VALUES, **DEATHS})[kind]):
        raise UserError(message)
    assert left_of(groups) == []


@pytest.mark.parametrize("kind", [*HANGS, "reset_sleeps"])
def test_a_worker_that_hangs_is_ended_at_its_time_out(kind):
    engine = SubprocessEngine([FaultyEnv, partial(FaultyEnv, kind, STEP)], "mine", timeouts=TIMEOUTS)
    groups, began = workers_of(), time.monotonic()
    message = failure(engine)
    passed = time.monotonic() - began
    limit, when = (2 * TIMEOUT, "the reset after step 8") if kind == "reset_sleeps" else (TIMEOUT, f"step {STEP}")
    assert message.startswith(f"mine, worker 1 of 2, {when}: gave no answer within {limit:g} s")
    assert limit <= passed < limit + CLEAN
    assert left_of(groups) == []


def test_a_workers_own_traceback_comes_along():
    with pytest.raises(UserError) as caught:
        play(SubprocessEngine([partial(FaultyEnv, "raises", STEP)], "mine"), STEP)
    assert any("in raises" in note and "ZeroDivisionError" in note for note in caught.value.__notes__)


def test_faults_of_construction_are_named():
    for maker, words in (
        (partial(FaultyEnv, "construction_raises"), "construction: raised FileNotFoundError: no level 3"),
        (OtherSpaceEnv, r"construction: has the action space Discrete\(3\), but the first one made has Discrete\(2\)"),
    ):
        with pytest.raises(UserError, match=f"mine, worker 1 of 2, {words}"):
            SubprocessEngine([FaultyEnv, maker], "mine")
    with pytest.raises(UserError, match="mine, worker 0 of 1, construction: gave no answer within 2 s"):
        SubprocessEngine([partial(FaultyEnv, "construction_sleeps")], "mine", timeouts=TIMEOUTS._replace(start=2.0))
    assert workers_of() == []


def test_a_maker_that_cannot_be_sent_is_named():
    lock = threading.Lock()
    with pytest.raises(UserError, match=r"mine cannot be sent to a worker process .*engine='gymnasium'"):
        SubprocessEngine([lambda: FaultyEnv("nothing", lock)], "mine")
    assert workers_of() == []


def test_an_interrupted_wait_ends_the_pool():
    """Answers that were not taken must not be those of the next step."""
    engine = SubprocessEngine([partial(FaultyEnv, "sleeps", STEP)], "mine")
    groups = workers_of()
    threading.Timer(0.3, _thread.interrupt_main).start()
    with pytest.raises(KeyboardInterrupt):
        play(engine, STEP)
    with pytest.raises(ValueError, match="make the engine anew"):
        engine.step(np.zeros(1, np.int32))
    assert left_of(groups) == []


def test_a_pool_that_is_closed_or_forgotten_leaves_nothing():
    for end in (lambda pool: pool.close(), lambda pool: None):
        engine = SubprocessEngine([FaultyEnv], "mine")
        engine.reset([0])
        groups = workers_of()
        end(engine)
        del engine
        assert groups and left_of(groups) == []


def test_workers_start_without_jax():
    code = "import sys, thorndike.environments.host.worker; sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_actions_reach_workers_as_their_spaces_say():
    engine = SubprocessEngine([WideBoxEnv] * 2, "wide")
    engine.reset([0, 0])
    np.testing.assert_array_equal(engine.step(np.array([[-9.0], [1.5]], np.float32)).reward, [-2, 1.5])
    engine.close()
    engine = SubprocessEngine([GreedyDiscreteEnv] * 2, "greedy")
    np.testing.assert_array_equal(engine.reset([0, 0]), [1, 1])
    np.testing.assert_array_equal(engine.step(np.array([0, 1], np.int32)).reward, [5, 6])
    engine.close()


# Kills and hangs at any moment.


def true_steps(engine, seconds: float) -> int:
    """Steps of counting environments until a fault; each one that is returned is checked. How many there were."""
    obs, steps, until = engine.reset(range(engine.spec.num_envs)), 0, time.monotonic() + seconds
    np.testing.assert_array_equal(obs[:, 0], np.arange(engine.spec.num_envs) * EPISODES_PER_SEED)
    while time.monotonic() < until:
        step = engine.step(np.zeros(engine.spec.num_envs, np.int32))
        episode, count = obs.T.astype(int)
        np.testing.assert_array_equal(step.next_obs, np.stack([episode, count + 1], -1))
        np.testing.assert_array_equal(step.reward, count + 1)
        np.testing.assert_array_equal(step.terminated | step.truncated, count + 1 == length_of(episode, LONGEST))
        obs, steps = step.obs, steps + 1
    return steps


def kill_one(rng: random.Random) -> float:
    """A worker is killed at a random moment of 50 ms of steps; how long until all is over."""
    engine = SubprocessEngine([partial(CountingEnv, LONGEST)] * 2, "counting", timeouts=TIMEOUTS)
    groups, row, killed = sorted(workers_of()), rng.randrange(2), []

    def kill():
        os.kill(groups[row], signal.SIGKILL)
        killed.append(time.monotonic())

    threading.Timer(rng.uniform(0, 0.05), kill).start()
    with pytest.raises(UserError, match=rf"counting, worker {row} of 2, (step \d+|the .*reset.*): was killed by signal 9"):
        true_steps(engine, 30.0)
    passed = time.monotonic() - killed[0]
    assert left_of(groups, 0.0 if passed > CLEAN else CLEAN - passed) == []
    return passed


def hang_one(kind: str, rng: random.Random) -> float:
    """How long it takes, from the time-out on, until a worker that hangs and everything else is over."""
    at = rng.randrange(1, 30)
    engine = SubprocessEngine([partial(FaultyEnv, kind, at), FaultyEnv], "mine", timeouts=TIMEOUTS)
    groups = workers_of()
    play(engine, at - 1)
    began = time.monotonic()
    with pytest.raises(UserError, match=rf"mine, worker 0 of 2, step {at}: gave no answer within 1 s"):
        engine.step(np.zeros(2, np.int32))
    passed = time.monotonic() - began - TIMEOUT
    assert left_of(groups, 0.0 if passed > CLEAN else CLEAN - passed) == []
    return passed


def report(times: list[float], kind: str) -> None:
    print(f"{len(times)} {kind}: over after {np.median(times):.3f} s in the median, {max(times):.3f} s at most; 0 processes left")


def test_workers_killed_at_random_moments_are_named_and_leave_nothing():
    assert max(kill_one(random.Random(seed)) for seed in range(4)) < CLEAN


@pytest.mark.slow
def test_a_hundred_kills_and_twenty_hangs_are_over_in_two_seconds():
    kills = [kill_one(random.Random(seed)) for seed in range(100)]
    report(kills, "kills")
    hangs = [hang_one(HANGS[seed % len(HANGS)], random.Random(seed)) for seed in range(20)]
    report(hangs, "hangs")
    assert max(kills) < CLEAN and max(hangs) < CLEAN
    assert workers_of() == []


# A run.

FILE = Path(__file__).parent / "faulty_environments.py"


def test_a_run_stops_with_the_fault_and_leaves_no_process(tmp_path):
    with pytest.raises(UserError, match=r"StepsEnv, worker \d of 2, step 70: raised ZeroDivisionError"):
        td.train(
            "q_learning",
            f"{FILE}:StepsEnv",
            env_kwargs={"fault": "raises", "at": 70},
            engine="subprocess",
            env_timeout=30.0,
            num_envs=2,
            steps=1000,
            output=tmp_path,
        )
    (record,) = tmp_path.glob("*/*/*/run.json")
    assert json.loads(record.read_text())["status"] == "failed"
    assert workers_of() == []


def test_a_wrong_time_out_is_named(tmp_path):
    with pytest.raises(UserError, match="env_timeout must be a number of seconds above 0, not 0"):
        td.make(f"{FILE}:StepsEnv", 1, engine="subprocess", env_timeout=0.0)


@pytest.mark.parametrize("fault", ["nothing", "hangs_in_native_code"])
def test_no_worker_outlives_a_training_that_is_killed(fault, tmp_path):
    """Not even one that hangs with the interpreter's lock held."""
    code = f"""
import thorndike as td
td.train("q_learning", {str(FILE) + ":StepsEnv"!r}, engine="subprocess", num_envs=2, steps=10**9, output={str(tmp_path)!r},
         env_kwargs={{"fault": {fault!r}, "at": 200}})
"""
    training = subprocess.Popen([sys.executable, "-c", code])
    groups: list[int] = []
    deadline = time.monotonic() + 60
    while (len(groups) < 2 or not list(tmp_path.glob("*/*/*/run.json"))) and training.poll() is None and time.monotonic() < deadline:
        time.sleep(0.05)
        groups = workers_of(training.pid)
    assert len(groups) == 2
    time.sleep(2.0)
    assert training.poll() is None
    training.kill()
    training.wait()
    assert left_of(groups, CLEAN) == []
