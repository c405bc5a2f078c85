"""Learning dynamics in runs: at a few log points only, without a trace in training, and the same again after a resume."""

import json
import signal
from pathlib import Path

import numpy as np
import pytest

import thorndike as td
from thorndike.training import session
from thorndike.training.metrics import MetricsLog
from thorndike.training.session import Plan
from thorndike.training.time_shares import Clock, SegmentTimes
from training.kill_and_resume import TIMES, contents, difference
from training.tiny_environments import PPO_SETTINGS, Corridor

pytestmark = pytest.mark.usefixtures("quick_compile")
REQUEST = {"seeds": 2, "num_envs": 4, "preset": "none"}
DQN_SETTINGS = {"net_arch": (8,), "learning_starts": 64, "buffer_size": 640, "train_freq": 32, "batch_size": 16}
LOOKED_AT = (10, 15, 20)
SHARES = {"time/environment", "time/acting", "time/learning", "time/waiting"}


def rows_of(run: Path) -> list[dict]:
    return [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]


def sparse(rows: list[dict]) -> list[set[str]]:
    """What only some lines have: names of modules are behind a second stroke."""
    return [{name for name in row if name.count("/") >= 2 or name == "train/replay_age"} for row in rows]


@pytest.fixture(scope="module", params=["ppo", "dqn"])
def runs(request, tmp_path_factory) -> tuple[Path, Path]:
    """The same compiled run with and without."""
    folder, settings = tmp_path_factory.mktemp("runs"), {"ppo": PPO_SETTINGS, "dqn": DQN_SETTINGS}[request.param]
    made = [td.train(request.param, "CartPole-v1", steps=640, settings=settings, output=folder / "with", **REQUEST).run]
    before, session.FIRST_LOOK = session.FIRST_LOOK, 1_000
    try:
        made.append(td.train(request.param, "CartPole-v1", steps=640, settings=settings, output=folder / "without", **REQUEST).run)
    finally:
        session.FIRST_LOOK = before
    return made[0], made[1]


def test_every_fifth_log_point_from_the_tenth_has_them(runs):
    rows, plain = rows_of(runs[0]), rows_of(runs[1])
    assert len(rows) == 20
    found = sparse(rows)
    assert [i for i, names in enumerate(found, 1) if names] == list(LOOKED_AT)
    assert not any(sparse(plain))
    kinds = {"train/" + name.split("/")[1] for name in found[-1]}
    assert kinds >= {"train/dead_units", "train/effective_rank", "train/grad_norm"}
    for i in LOOKED_AT:
        for name in found[i - 1]:
            assert len(rows[i - 1][name]) == 2 and np.isfinite(rows[i - 1][name]).all()
        assert all(0 <= share <= 1 for name in found[i - 1] if "dead_units" in name for share in rows[i - 1][name])
    if "train/replay_age" in rows[-1]:
        # 160 steps of 4 environments fill the memory of 640 to its last row.
        assert rows[-1]["train/replay_age"] == [pytest.approx(4 * 159 / 2)] * 2


def test_training_knows_nothing_of_them(runs):
    for ours, theirs in zip(rows_of(runs[0]), rows_of(runs[1]), strict=True):
        for name in theirs.keys() - set(TIMES):
            assert ours[name] == theirs[name], name
    names = [sorted(path.name for path in (run / "checkpoints").iterdir()) for run in runs]
    assert names[0] == names[1]
    for name in [*(f"checkpoints/{step}" for step in names[0])]:
        assert contents(runs[0] / name) == contents(runs[1] / name)


@pytest.mark.slow
def test_they_say_the_same_of_an_agent_alone_and_among_others(runs, tmp_path):
    if json.loads((runs[0] / "run.json").read_text())["algorithm"] == "dqn":
        alone = td.train("dqn", "CartPole-v1", steps=640, settings=DQN_SETTINGS, output=tmp_path, **REQUEST | {"seeds": 1}).run
        ours, theirs = rows_of(runs[0])[-1], rows_of(alone)[-1]
        assert {name: ours[name][0] for name in sparse([ours])[0]} == {name: theirs[name][0] for name in sparse([theirs])[0]}


def test_a_host_run_has_them_with_its_shares_of_time_and_resumes_to_the_same(tmp_path, monkeypatch):
    request = {"steps": 640, "settings": PPO_SETTINGS, "checkpoint_every": 160, **REQUEST}
    whole = td.train("ppo", Corridor, output=tmp_path / "whole", **request).run
    write, written = MetricsLog.write, []

    def then_interrupted(*arguments):
        written.append(1)
        if len(written) == 13:
            signal.raise_signal(signal.SIGINT)
        return write(*arguments)

    monkeypatch.setattr(MetricsLog, "write", then_interrupted)
    stopped = td.train("ppo", Corridor, output=tmp_path / "stopped", **request)
    monkeypatch.undo()
    assert stopped.status == "interrupted"
    assert td.resume(stopped.run, environment=Corridor).status == "finished"
    assert difference(whole, stopped.run) is None
    rows = rows_of(whole)
    assert [i for i, names in enumerate(sparse(rows), 1) if names] == list(LOOKED_AT)
    for row in rows:
        shares = {name: row[name] for name in SHARES}
        assert all(0 <= share <= 1 for share in shares.values()), shares
        assert 0.2 < sum(shares.values()) <= 1.0


def test_they_come_late_and_seldom_however_a_run_is_cut():
    plan = Plan(iterations=200, log_every=2, checkpoint_every=7, also=(21, 33))
    assert [i for i in range(1, 61) if plan.looks(i)] == [20, 30, 40, 50, 60]


class Slow(Clock):
    """A pool that says it spent so much."""

    def spend(self, environment: float, waiting: float) -> None:
        self.environment.seconds += environment
        self.waiting.seconds += waiting


def test_shares_are_of_the_segment_alone(monkeypatch):
    now = [100.0]
    monkeypatch.setattr("thorndike.training.time_shares.time.perf_counter", lambda: now[0])
    clock = Slow()
    clock.spend(50.0, 50.0)
    times = SegmentTimes(clock)
    clock.spend(4.0, 1.0)
    times.add(collecting=7.0, learning=2.0)
    now[0] = 110.0
    assert times.shares() == pytest.approx((0.4, 0.2, 0.2, 0.1))
