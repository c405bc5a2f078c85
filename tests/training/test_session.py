"""A session on a runner that only counts: what it keeps when the disk refuses, and when it is stopped."""

import json
import os
import shutil
import signal
from pathlib import Path

import jax.numpy as jnp
import pytest

from thorndike.errors import UserError
from thorndike.training.checkpoints import Progressed
from thorndike.training.host_source import HostSource
from thorndike.training.metrics import last_points
from thorndike.training.progress import Progress
from thorndike.training.runner import Runner
from thorndike.training.segment import Report
from thorndike.training.session import Keeping, Outcome, Plan, Start, run_session
from thorndike.types import EpisodeStats

PER_ITERATION = 10
PLAN = Plan(iterations=12, log_every=2, checkpoint_every=4)
FULL = OSError(28, "No space left on device")


class Counting:
    """A runner whose carry is the number of iterations made; ``when`` maps iterations to what happens in the segment that begins there."""

    def __init__(self, **when):
        self.when = {int(name[2:]): action for name, action in when.items()}
        self.segments = []

    def advance(self, carry, first, count):
        self.segments.append((first, count))
        self.when.pop(first, lambda: None)()
        numbers = jnp.full((1,), float(carry + count))
        return carry + count, Report({"train/loss": numbers}, EpisodeStats(numbers, numbers, numbers, numbers))

    def runner(self) -> Runner:
        return Runner(lambda: 0, self.advance, PER_ITERATION, lambda: 0.0, lambda: 0.0)


class Kept:
    """What was saved and exported; ``refuse`` says at which iterations the disk refuses, or the policy does not fit."""

    def __init__(self, refuse=(), refuse_policy=()):
        self.refuse, self.refuse_policy = refuse, refuse_policy
        self.saved, self.exported = [], []

    def save(self, carry, progressed):
        if progressed.iteration in self.refuse:
            raise FULL
        self.saved.append(carry)

    def export(self, carry, points):
        if carry in self.refuse_policy:
            raise FULL
        self.exported.append((carry, [point.steps for point in points]))


def session(run: Path, counting: Counting, kept: Kept, source=None, start: int = 0, plan: Plan = PLAN, recent=()) -> Outcome:
    begin = Start(start, Progressed(start, 0.0, 0.0), recent)
    return run_session(run, counting.runner(), source, plan, begin, Keeping(kept.save, kept.export), Progress(120, enabled=False))


def logged(run: Path) -> list[int]:
    return [json.loads(line)["steps"] for line in (run / "metrics.jsonl").read_text().splitlines()]


def ask(number: int):
    return lambda: os.kill(os.getpid(), number)


def test_lines_and_checkpoints_come_where_the_plan_says(tmp_path):
    kept, counting = Kept(), Counting()
    outcome = session(tmp_path, counting, kept, plan=Plan(13, 3, 4, also=(5, 11)))
    assert (outcome.status, outcome.steps, outcome.saved_steps, outcome.signal) == ("finished", 130, 130, None)
    assert [first + count for first, count in counting.segments] == [3, 4, 5, 6, 8, 9, 11, 12, 13]
    assert logged(tmp_path) == [30, 40, 50, 60, 80, 90, 110, 120, 130]
    assert kept.saved == [4, 5, 8, 11, 12, 13]
    assert [carry for carry, _ in kept.exported] == kept.saved


def test_where_the_disk_refuses_training_goes_on_and_tries_again(tmp_path, capsys):
    kept = Kept(refuse=(4,), refuse_policy=(8,))
    outcome = session(tmp_path, Counting(), kept)
    assert (outcome.status, outcome.saved_steps) == ("finished", 120)
    assert kept.saved == [8, 12]
    assert [carry for carry, _ in kept.exported] == [12]
    told = capsys.readouterr().err
    assert told.count(f"thorndike: a checkpoint of {tmp_path} could not be written: No space left on device; training goes on") == 2
    assert told.count("\n") == 2


@pytest.mark.parametrize("kept", [Kept(refuse=(12,)), Kept(refuse_policy=(12,))], ids=["checkpoint", "policy"])
def test_if_the_last_checkpoint_fails_that_is_said_with_what_to_do(tmp_path, kept):
    with pytest.raises(UserError, match=f"last checkpoint of {tmp_path} .*: No space left .* thorndike resume {tmp_path}") as error:
        session(tmp_path, Counting(), kept)
    assert "\n" not in str(error.value)


def test_a_directory_that_is_gone_ends_the_session_at_once(tmp_path):
    run = tmp_path / "run"
    run.mkdir()
    counting = Counting(at2=lambda: shutil.rmtree(run))
    with pytest.raises(UserError, match=f"{run} is gone"):
        session(run, counting, Kept())
    assert counting.segments[-1] == (2, 2)
    assert not run.exists()


def test_lines_that_do_not_fit_are_written_later_and_no_checkpoint_comes_before_them(tmp_path, monkeypatch, capsys):
    real_write, full = os.write, []

    def write(descriptor, data):
        if full:
            raise FULL
        return real_write(descriptor, data)

    monkeypatch.setattr(os, "write", write)
    kept = Kept()
    counting = Counting(at2=lambda: full.append(1), at8=full.clear)
    session(tmp_path, counting, kept)
    assert logged(tmp_path) == [20, 40, 60, 80, 100, 120]
    assert kept.saved == [12]
    told = capsys.readouterr().err.splitlines()
    assert f"{tmp_path}/metrics.jsonl cannot be written: No space left on device; training goes on" in told[0]
    assert len([line for line in told if "a checkpoint of" in line]) == 2


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_session_after_its_segment_and_the_state_is_kept(tmp_path, number):
    kept, counting = Kept(), Counting(at4=ask(number))
    outcome = session(tmp_path, counting, kept)
    assert (outcome.status, outcome.steps, outcome.saved_steps, outcome.signal) == ("interrupted", 60, 60, number)
    assert kept.saved == [4, 6]
    assert logged(tmp_path) == [20, 40, 60]


def test_at_a_checkpoint_it_is_not_written_twice(tmp_path):
    kept = Kept()
    outcome = session(tmp_path, Counting(at2=ask(signal.SIGINT)), kept)
    assert (outcome.steps, outcome.saved_steps) == (40, 40)
    assert kept.saved == [4]


HOST = HostSource(None, None)


def test_of_host_environments_nothing_newer_is_kept_and_that_is_said(tmp_path, capsys):
    kept = Kept()
    outcome = session(tmp_path, Counting(at4=ask(signal.SIGTERM)), kept, HOST)
    assert (outcome.status, outcome.steps, outcome.saved_steps) == ("interrupted", 60, 40)
    assert kept.saved == [4]
    assert "saved at checkpoints only: resume goes on from step 40, not from 60" in capsys.readouterr().err


def test_environments_that_die_of_the_signal_too_are_no_failure(tmp_path):
    def both():
        os.kill(os.getpid(), signal.SIGINT)
        raise BrokenPipeError

    outcome = session(tmp_path, Counting(at6=both), Kept(), HOST)
    assert (outcome.status, outcome.steps, outcome.saved_steps) == ("interrupted", 60, 40)
    with pytest.raises(BrokenPipeError):
        session(tmp_path, Counting(at6=both), Kept())


def test_a_second_signal_acts_at_once(tmp_path):
    def twice():
        ask(signal.SIGINT)()
        ask(signal.SIGINT)()

    kept = Kept()
    with pytest.raises(KeyboardInterrupt):
        session(tmp_path, Counting(at4=twice), kept)
    assert kept.saved == [4]


def test_a_resumed_session_writes_the_policy_anew_from_the_same_log_points(tmp_path):
    whole, first, second = Kept(), Kept(), Kept()
    run = tmp_path / "stopped"
    for folder in (run, tmp_path / "whole"):
        folder.mkdir()
    session(tmp_path / "whole", Counting(), whole)
    session(run, Counting(at6=ask(signal.SIGINT)), first)
    session(run, Counting(), second, start=8, recent=last_points(run, 10, 1))
    assert [carry for carry, _ in second.exported] == [8, 12]
    assert second.exported[-1] == whole.exported[-1]
    assert logged(run) == logged(tmp_path / "whole")


def test_a_finished_run_that_is_resumed_only_renews_its_policy(tmp_path):
    kept, counting = Kept(), Counting()
    outcome = session(tmp_path, counting, kept, start=12)
    assert (outcome.status, outcome.steps, counting.segments, kept.saved) == ("finished", 120, [], [])
    assert kept.exported == [(12, [])]


def test_what_is_not_finite_is_not_kept(tmp_path):
    def advance(carry, first, count):
        loss = jnp.array([jnp.nan if first == 4 else 1.0])
        return carry + count, Report({"train/loss": loss}, EpisodeStats(loss, loss, loss, loss))

    counting, kept = Counting(), Kept()
    counting.advance = advance
    with pytest.raises(UserError, match="train/loss of seed 0 is not finite by step 60"):
        session(tmp_path, counting, kept)
    assert kept.saved == [4]
