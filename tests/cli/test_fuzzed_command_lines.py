"""Whatever is wrong with a command line or a run's files: one line, exit status 2, no traceback, at once."""

import itertools
import json
import os
import random
import resource
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import pytest

from cli.mistaken_words import KINDS, Mistake, furnish, mistakes
from thorndike.cli.main import main

SEED = 20261122


class Answered(NamedTuple):
    """What a command did."""

    status: int
    out: str
    err: str
    cpu_s: float = 0.0


def fault(mistake: Mistake, answered: Answered) -> str | None:
    """What is wrong with the answer to a mistake."""
    lines = answered.err.splitlines()
    if answered.status != 2:
        return f"exit status {answered.status}"
    if len(lines) != 1 or not answered.err.endswith("\n") or not lines[0].startswith("thorndike: "):
        return f"{len(lines)} lines"
    if len(lines[0]) > 2000 or not lines[0].isprintable():
        return "a line that is too long, or not fit to be printed"
    if "--json" not in mistake.words:
        return "words on stdout" if answered.out else None
    told = json.loads(answered.out) if answered.out.count("\n") == 1 else {}
    return None if list(told) == ["error"] and f"thorndike: {told['error']}" == lines[0] else "no object with an error on stdout"


def in_process(mistake: Mistake, capfd) -> Answered:
    status = main(mistake.words)
    out, err = capfd.readouterr()
    return Answered(status, out, err)


def in_a_process(mistake: Mistake, place: Path, source: Path) -> Answered:
    """The command as a user gives it, and the processor time of it and of all it started."""
    environment = {**os.environ, "PYTHONPATH": str(source), "PYTHONIOENCODING": "utf-8:backslashreplace"}
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    words = [word.encode("utf-8", "surrogateescape") for word in mistake.words]
    done = subprocess.run([sys.executable, "-m", "thorndike", *words], cwd=place, env=environment, capture_output=True, check=False)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Answered(done.returncode, done.stdout.decode(), done.stderr.decode(), spent)


def everything_in(place: Path) -> set[str]:
    return {str(path) for path in place.rglob("*") if "__pycache__" not in path.parts}


@pytest.fixture
def place(tmp_path, monkeypatch) -> Path:
    furnish(tmp_path / "place")
    monkeypatch.chdir(tmp_path / "place")
    return tmp_path / "place"


def test_a_hundred_and_fifty_mistakes_are_one_line_each(place, capfd):
    before = everything_in(place)
    drawn = list(itertools.islice(mistakes(random.Random(SEED), place), 150))
    faults = [(mistake, fault(mistake, answered)) for mistake in drawn for answered in [in_process(mistake, capfd)]]
    assert [(mistake, found) for mistake, found in faults if found] == []
    assert {mistake.kind for mistake in drawn} == set(KINDS)
    assert everything_in(place) == before, "a mistake makes no file"


@pytest.mark.slow
def test_two_thousand_mistakes_are_one_line_each_in_under_half_a_second(place):
    source = Path(__file__).parents[2] / "src"
    before, faults, times, kinds = everything_in(place), [], [], Counter()
    for mistake in itertools.islice(mistakes(random.Random(SEED + 1), place), 2000):
        answered = in_a_process(mistake, place, source)
        if answered.cpu_s >= 0.5:
            # Once more: the machine may have been busy with other things.
            answered = min(answered, *(in_a_process(mistake, place, source) for _ in range(4)), key=lambda each: each.cpu_s)
        found = fault(mistake, answered)
        faults += [] if found is None else [(mistake.kind, str(mistake.words)[:200], found, answered.err[-300:])]
        times.append((answered.cpu_s, mistake.kind, str(mistake.words)[:200]))
        kinds[mistake.kind] += 1
    times.sort()
    slow = [each for each in times if each[0] >= 0.5]
    print(
        f"\n2,000 mistakes of {len(kinds)} kinds: {len(faults)} answered wrongly, {len(slow)} in 0.5 s or more; "
        f"median {times[1000][0]:.2f} s, slowest {times[-1]}"
    )
    assert (faults, slow) == ([], [])
    assert everything_in(place) == before, "a mistake makes no file"
