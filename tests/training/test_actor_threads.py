"""Actor threads: every step that an environment gives is learnt from once, faults neither block nor lose, two runs are equal."""

import itertools
import json
import random
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import gymnasium
import jax
import numpy as np
import pytest
from gymnasium import spaces

import thorndike as td
from environments.processes import workers_of
from thorndike.algorithms import impala
from thorndike.environments import wrappers
from thorndike.environments.host.gymnasium_engine import LoopEngine
from thorndike.errors import UserError
from thorndike.training import actor_threads
from thorndike.training.actor_threads import ActorThreads, ThreadedSource, threaded_source
from thorndike.training.runner import runner

LENGTH, SEGMENT, SEED = 4, 6, 3
CONFIG = impala.Config(n_steps=LENGTH, net_arch=(4,), policy_lag=0)
FILES = Path(__file__).parents[1] / "environments"


class NumberedEnv(gymnasium.Env):
    """Every step of every environment has a number of its own, which the next observation tells; some steps raise."""

    numbers = itertools.count(1)
    given: list[int]
    """The steps that returned."""
    faults: list[int]

    def __init__(self, chance: float = 0.0, wait: float = 0.0) -> None:
        self.chance, self.wait, self.rng = chance, wait, random.Random()
        self.observation_space = spaces.Box(-1, 2**24, (2,), np.float32)
        self.action_space = spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        if seed is not None:
            self.rng.seed(seed)
        self.count, self.length = 0, self.rng.randrange(1, 9)
        return np.array([-1, 0], np.float32), {}

    def step(self, action):
        time.sleep(self.wait * self.rng.random())
        number = next(NumberedEnv.numbers)
        if self.rng.random() < self.chance:
            NumberedEnv.faults.append(number)
            raise RuntimeError(f"fault {len(NumberedEnv.faults)}")
        self.count += 1
        NumberedEnv.given.append(number)
        ends = self.count == self.length
        return np.array([number, self.count], np.float32), float(self.count), ends and self.length % 2 == 0, ends and self.length % 2, {}


@pytest.fixture(autouse=True)
def counted():
    NumberedEnv.given, NumberedEnv.faults = [], []
    yield
    assert not [thread.name for thread in threading.enumerate() if thread.name.startswith("actor")], "no thread is left"


class Play(NamedTuple):
    source: ThreadedSource
    act: Callable
    """state, actor, iteration -> state, rollout, episodes."""
    actor: object


def start(threads: int, asked: ActorThreads, chance: float = 0.0, wait: float = 0.0, num_envs: int = 1, make=NumberedEnv) -> Play:
    build = partial(LoopEngine, [partial(make, chance, wait)] * num_envs, "numbered")
    engines = [build() for _ in range(threads)]
    algorithm = impala.impala(CONFIG, engines[0].spec)
    source = threaded_source(engines, build, algorithm, wrappers.chain(), SEED, [0], SEGMENT, asked)
    keys = jax.random.split(jax.random.key(0), 1)
    actor = jax.vmap(lambda key: algorithm.actor(algorithm.init(key)))(keys)

    def act(state, actor, iteration: int):
        return source.source.source.collect(state, actor, jax.vmap(lambda key: jax.random.fold_in(key, iteration))(keys))

    return Play(source, act, actor)


def collect(play: Play, iterations: int) -> list:
    state = play.source.source.source.init(jax.random.split(jax.random.key(0), 1))
    rollouts = []
    for iteration in range(iterations):
        state, rollout, episodes = play.act(state, play.actor, iteration)
        assert episodes.steps[0] == rollout.step.valid.sum()
        rollouts.append(rollout)
    return rollouts


def within(seconds: float, work: Callable[[], object]) -> object:
    """What ``work`` gives, or raises; a deadlock is a failure and not a test that never ends."""
    outcome: list = []

    def run() -> None:
        try:
            outcome.append((work(), None))
        except BaseException as error:
            outcome.append((None, error))

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    thread.join(seconds)
    assert outcome, f"no end within {seconds} s: a deadlock"
    if outcome[0][1] is not None:
        raise outcome[0][1]
    return outcome[0][0]


def learnt(rollouts: list) -> np.ndarray:
    """The numbers of all steps learnt from, in order."""
    return np.concatenate([rollout.step.next_obs[..., 0].ravel() for rollout in rollouts]).astype(int)


def check_rows(rollout) -> None:
    """Each row begins where the one before ended, or anew where an episode ended; the reward is that of its step."""
    step = rollout.step
    np.testing.assert_array_equal(step.reward, step.next_obs[..., 1])
    np.testing.assert_array_equal(rollout.obs[..., 1] + 1, step.next_obs[..., 1])
    goes_on = ~step.done[:, :-1]
    np.testing.assert_array_equal(rollout.obs[:, 1:][goes_on], step.next_obs[:, :-1][goes_on])
    assert (rollout.obs[:, 1:, :, 1][~goes_on] == 0).all()


def play_through(faults: int, schedule: str, threads: int = 3, num_envs: int = 1) -> tuple[int, int]:
    """Segments until so many faults: every step that was given was learnt from once. How many faults and steps there were."""
    build = partial(LoopEngine, [partial(NumberedEnv, 0.05, 0.0005)] * num_envs, "numbered")
    engines = [build() for _ in range(threads)]
    algorithm = impala.impala(CONFIG, engines[0].spec)
    asked = ActorThreads(threads, schedule, 10_000)
    source, close = threaded_source(engines, build, algorithm, wrappers.chain(), SEED, [0], SEGMENT, asked)
    rollouts: list = []

    def collect(state, actor, noise):
        state, rollout, episodes = source.source.collect(state, actor, noise)
        rollouts.append(rollout)
        return state, rollout, episodes

    def work() -> None:
        bound = runner(algorithm, source._replace(source=source.source._replace(collect=collect)), SEED, [0])
        carry, iteration = bound.init(), 0
        while len(NumberedEnv.faults) < faults:
            carry, report = bound.advance(carry, iteration, SEGMENT)
            iteration += SEGMENT
            assert all(np.isfinite(values).all() for values in report.metrics.values())
            assert report.episodes.steps[0] == SEGMENT * LENGTH * num_envs

    try:
        within(300, work)
    finally:
        close()
    for rollout in rollouts:
        check_rows(rollout)
    numbers = learnt(rollouts)
    assert len(np.unique(numbers)) == len(numbers) == len(rollouts) * LENGTH * num_envs, "no step twice"
    if num_envs == 1:
        assert sorted(numbers) == sorted(NumberedEnv.given), "no step lost"
    else:
        # Of a step in which another environment of the pool raised, nothing is used.
        lost = set(NumberedEnv.given) - set(numbers)
        assert set(numbers) <= set(NumberedEnv.given) and len(lost) <= len(NumberedEnv.faults) * (num_envs - 1)
    return len(NumberedEnv.faults), len(numbers)


@pytest.mark.parametrize(("schedule", "num_envs"), [("fixed", 1), ("free", 1), ("free", 3)])
def test_a_hundred_faults_lose_no_step_and_block_nothing(schedule, num_envs):
    faults, steps = play_through(100, schedule, num_envs=num_envs)
    print(f"{schedule}, {num_envs} environments a thread: {faults} faults, {steps} steps, none lost, none twice")
    assert faults >= 100


@pytest.mark.slow
@pytest.mark.parametrize("schedule", ["fixed", "free"])
def test_two_thousand_faults_of_eight_threads_lose_no_step_and_block_nothing(schedule):
    faults, steps = play_through(2000, schedule, threads=8)
    print(f"{schedule}, 8 threads: {faults} faults, {steps} steps, none lost, none twice")
    assert faults >= 2000


def test_the_schedule_says_whose_rollout_is_next_and_how_old_its_actor_is():
    play = start(2, ActorThreads(2))
    try:
        state = play.source.source.source.init(jax.random.split(jax.random.key(0), 1))
        versions = []
        for iteration in range(2 * SEGMENT):
            actor = play.actor._replace(version=np.full(1, iteration, np.int32))
            state, rollout, _ = within(60, partial(play.act, state, actor, iteration))
            versions.append(iteration - int(rollout.extras["version"][0, 0, 0]))
    finally:
        play.source.close()
    assert versions == [0, 1, 2, 2, 2, 2] * 2


def test_the_fixed_schedule_gives_the_same_twice_and_ends_every_segment_with_a_cut():
    found = []
    for wait in (0.0, 0.001):
        play = start(2, ActorThreads(2), wait=wait)
        rollouts = within(60, partial(collect, play, 2 * SEGMENT))
        play.source.close()
        found.append([(rollout.action, rollout.obs[..., 1], rollout.step.done) for rollout in rollouts])
    jax.tree.map(np.testing.assert_array_equal, *found)
    ends = [bool(done[0, -1, 0]) for _, _, done in found[0]]
    assert all(ends[i] for i in (SEGMENT - 2, SEGMENT - 1, 2 * SEGMENT - 2, 2 * SEGMENT - 1))


def test_a_fault_beyond_the_restarts_is_the_learners_and_nothing_hangs():
    play = start(3, ActorThreads(3, "fixed", 2), chance=0.2)
    with pytest.raises(UserError, match=r"numbered, environment 0 of 1, step \d+: raised RuntimeError: fault"):
        within(60, partial(collect, play, 50 * SEGMENT))
    within(20, play.source.close)
    assert len(NumberedEnv.faults) >= 3


def test_an_environment_that_never_comes_back_does_not_hold_up_the_end(monkeypatch, capsys):
    monkeypatch.setattr(actor_threads, "_GRACE_S", 0.2)
    entered, released = threading.Event(), threading.Event()

    class Hangs(NumberedEnv):
        def step(self, action):
            entered.set()
            released.wait()
            return super().step(action)

    play = start(1, ActorThreads(1), make=Hangs)
    threading.Thread(target=collect, args=(play, 1), daemon=True).start()
    assert entered.wait(60)
    within(10, play.source.close)
    assert "do not come out of their step" in capsys.readouterr().err
    released.set()
    within(10, lambda: [thread.join() for thread in threading.enumerate() if thread.name.startswith("actor")])


# Runs.

SMALL = {"n_steps": 4, "net_arch": (4,), "policy_lag": 0}


def lines(run: Path) -> list[dict]:
    told = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    return [{name: value for name, value in line.items() if name not in ("wall_s", "cpu_s", "time/fps")} for line in told]


def train(tmp_path: Path, environment: str = "counting_environments.py:CountingEnv", **settings):
    given = {"settings": SMALL, "engine": "gymnasium", "num_envs": 2, "steps": 192, "checkpoint_every": 96, "output": tmp_path} | settings
    return td.train("impala", f"{FILES / environment}" if ".py" in environment else environment, **given)


def test_a_run_is_the_same_twice_and_after_a_resume_with_normalised_observations(tmp_path):
    asked = {"actor_threads": 2, "seeds": 2, "wrappers": [td.wrappers.normalize_observation(), td.wrappers.normalize_reward(0.99)]}
    whole, half = train(tmp_path, **asked), train(tmp_path, **asked | {"steps": 96})
    on = td.resume(half.run, steps=192)
    assert lines(on.run) == lines(whole.run)
    assert json.loads((whole.run / "run.json").read_text())["actors"] == {"threads": 2, "schedule": "fixed", "restarts": 0}
    assert whole.steps == 192


@pytest.mark.slow
def test_worker_processes_are_made_anew_and_none_is_left(tmp_path, capfd):
    result = train(
        tmp_path, "faulty_environments.py:StepsEnv", env_kwargs={"fault": "dies", "at": 30}, engine="subprocess", actor_threads=2,
        env_restarts=50, actor_schedule="free", num_envs=1,
    )  # fmt: skip
    assert result.status == "finished" and result.steps == 192
    assert "killed by signal 9" in capfd.readouterr().err
    assert workers_of() == []


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"environment": "CartPole-v1", "engine": "native"}, "which needs no threads: leave --actor-threads out, or set policy_lag"),
        ({"actor_schedule": "loose"}, "on the schedule fixed or free"),
        ({"actor_threads": 0, "env_restarts": 2}, "give --actor-threads 1"),
    ],
)
def test_what_cannot_be_is_said_in_one_line(tmp_path, changed, words):
    with pytest.raises(UserError, match=words):
        train(tmp_path, **{"actor_threads": 2} | changed)


def test_learners_with_a_replay_memory_are_refused(tmp_path):
    with pytest.raises(UserError, match="learns from a replay memory"):
        td.train("dqn", "CartPole-v1", engine="gymnasium", actor_threads=2, steps=60_000, output=tmp_path)
