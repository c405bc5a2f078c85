"""One process writes a run; a lock never outlives the process that holds it."""

import os
import signal
import subprocess
import sys

import pytest

from thorndike.errors import UserError
from thorndike.training.run_lock import refuse_if_locked, run_lock

HOLD = """
import os, sys, time
from pathlib import Path
from thorndike.training.run_lock import run_lock
with run_lock(Path(sys.argv[1])):
    child = os.fork() if sys.argv[2] == "fork" else 1
    if child:
        print(child, flush=True)
    time.sleep(60)
"""


def holder(run, how):
    """A process that holds the lock, perhaps with a forked child; and that child's id."""
    process = subprocess.Popen([sys.executable, "-c", HOLD, str(run), how], stdout=subprocess.PIPE, text=True)
    return process, int(process.stdout.readline())


def test_a_second_process_is_refused_by_the_number_of_the_first(tmp_path):
    process, _ = holder(tmp_path, "alone")
    try:
        for attempt in (lambda: run_lock(tmp_path).__enter__(), lambda: refuse_if_locked(tmp_path)):
            with pytest.raises(UserError, match=f"process {process.pid} is writing {tmp_path}: .* kill {process.pid}"):
                attempt()
    finally:
        process.kill()
        process.wait()
    with run_lock(tmp_path):
        pass


def test_a_lock_dies_with_its_process_though_its_children_live(tmp_path):
    process, child = holder(tmp_path, "fork")
    process.kill()
    process.wait()
    try:
        os.kill(child, 0)
        refuse_if_locked(tmp_path)
        with run_lock(tmp_path):
            assert (tmp_path / "lock.json").exists()
    finally:
        os.kill(child, signal.SIGKILL)


def test_the_same_process_is_refused_too_and_afterwards_nothing_is_left(tmp_path):
    with run_lock(tmp_path), pytest.raises(UserError, match=f"process {os.getpid()} is writing"), run_lock(tmp_path):
        pass
    refuse_if_locked(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_file_left_by_a_process_that_died_does_not_matter(tmp_path):
    (tmp_path / "lock.json").write_text('{"process": 1}')
    refuse_if_locked(tmp_path)
    with run_lock(tmp_path):
        assert f'"process": {os.getpid()}' in (tmp_path / "lock.json").read_text()


def test_a_run_that_cannot_be_written_is_named(tmp_path):
    with (
        pytest.raises(UserError, match="nowhere cannot be written: No such file or directory; copy the run"),
        run_lock(tmp_path / "nowhere"),
    ):
        pass
