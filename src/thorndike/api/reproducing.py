"""``reproduce``: a run made again from its ``run.json``, and compared with what it left, bit for bit."""

import math
import signal
import tempfile
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np

from thorndike.api.building import EnvironmentLike, Job
from thorndike.api.learned_rewards import first_change
from thorndike.api.recorded_run import Objects, rebuild, request_in
from thorndike.api.starting import first_carry
from thorndike.errors import UserError
from thorndike.networks.network import NetworkBuilder
from thorndike.records import read_record
from thorndike.training.checkpoints import STATE, Progressed, restorable
from thorndike.training.json_files import Json
from thorndike.training.metrics import LogPoint
from thorndike.training.notices import notice
from thorndike.training.progress import Progress
from thorndike.training.run_directory import checkpoints, read_lines
from thorndike.training.sealed_folders import Damaged, SealedFolder
from thorndike.training.segment import Carry
from thorndike.training.session import Keeping, Start, run_session
from thorndike.training.tree_files import named_arrays, read_arrays
from thorndike.types import Wrapper

TIMES = ("wall_s", "cpu_s", "time/fps", "time/environment", "time/acting", "time/learning", "time/waiting")
"""What the clock says is no part of a run that could be made again."""
_PARTS = {"0": "learner", "1": "environments"}


class Reproduction(NamedTuple):
    """What came of making a run again."""

    run: Path
    identical: bool
    steps: int
    """Steps of each seed that were made again."""
    lines: int
    """Lines of ``metrics.jsonl`` found equal."""
    checkpoints: tuple[int, ...]
    """Steps of the checkpoints found equal: parameters, optimiser, replay, statistics, environments."""
    difference: str | None
    """The first difference."""


class _Differs(Exception):
    """Ends the session at the first difference."""


def reproduce(
    run: str | Path,
    *,
    steps: int | None = None,
    environment: EnvironmentLike | None = None,
    wrappers: Sequence[Wrapper] | None = None,
    network: NetworkBuilder | None = None,
    progress: bool = False,
) -> Reproduction:
    """Make a run again from its first step, as far as it came or to ``steps``, in a folder that is thrown away, and compare.

    Compared are the lines of ``metrics.jsonl`` without times, and every array of the checkpoints that the run still has.
    ``environment``, ``wrappers`` and ``network`` are needed again where they were Python objects. Raises ``UserError`` if the run cannot
    be made again, or has left nothing to compare with.
    """
    run, objects = Path(run), Objects(environment, wrappers, network)
    record = read_record(run)
    request = request_in(record, run, objects)
    changed = first_change(record)
    if changed is not None and (steps is None or steps > changed):
        raise UserError(f"{run} went on with another reward from step {changed}: it can be made again up to there: --steps {changed}")
    with closing(rebuild(record, request, run, objects)) as job, tempfile.TemporaryDirectory(prefix="thorndike-reproduce-") as folder:
        comparison = _Comparison(run, Path(folder), job, math.inf if steps is None else steps)
        plan = job.plan._replace(iterations=comparison.iterations[-1], also=comparison.iterations)
        keeping = Keeping(comparison.compare, _nothing)
        try:
            with Progress(comparison.steps[-1], progress) as bar:
                outcome = run_session(Path(folder), job.runner, job.source, plan, Start(first_carry(job)), keeping, bar)
        except _Differs as difference:
            return comparison.result(str(difference))
    if outcome.signal is not None:
        signal.raise_signal(outcome.signal)
    return comparison.result(None)


class _Comparison:
    """What a run has left, held against what is made again."""

    def __init__(self, run: Path, folder: Path, job: Job, limit: float) -> None:
        """Raises ``UserError`` if there is nothing up to the step ``limit``."""
        self._run, self._again, self._job, self._each = run, folder / "metrics.jsonl", job, job.runner.steps_per_iteration
        self._rows = [row for row in read_lines(run / "metrics.jsonl") if cast(float, row["steps"]) <= limit]
        self._stored = {int(path.name): path for path in checkpoints(run) if int(path.name) <= limit}
        # A log point is the mean over the steps since the one before: they are cut where the run's were.
        found = {int(cast(float, row["steps"])) for row in self._rows} | set(self._stored)
        self.steps = sorted(step for step in found if step > 0 and step % self._each == 0)
        if not self.steps:
            raise UserError(f"{run} has left nothing up to step {limit:g} to compare with; its first log point or checkpoint comes later")
        self.iterations = tuple(step // self._each for step in self.steps)
        self._done, self._lines, self._equal = 0, 0, list[int]()

    def compare(self, carry: Carry, progressed: Progressed) -> None:
        """At one step: all lines up to it, then every array. Raises ``_Differs``."""
        self._done = progressed.iteration * self._each
        rows = [row for row in self._rows if cast(float, row["steps"]) <= self._done]
        again = read_lines(self._again)
        for before, now in zip(rows[self._lines :], again[self._lines :], strict=False):
            _compare_rows(before, now)
            self._lines += 1
        if self._rows and len(rows) != len(again):
            raise _Differs(f"metrics.jsonl has {len(rows)} lines up to step {self._done}, and {len(again)} when made again")
        if self._done in self._stored:
            self._compare_arrays(carry, self._stored[self._done])

    def result(self, difference: str | None) -> Reproduction:
        """What was found, after the last comparison."""
        return Reproduction(self._run, difference is None, self._done, self._lines, tuple(self._equal), difference)

    def _compare_arrays(self, carry: Carry, path: Path) -> None:
        try:
            before = read_arrays(SealedFolder(path), STATE)
        except Damaged as error:
            notice(f"{error}: it is not compared")
            return
        now = named_arrays(restorable(carry, self._job.source))
        for name in sorted(before.keys() | now.keys()):
            _compare_array(f"checkpoint of step {path.name}, {_readable(name)}", before.get(name), now.get(name))
        self._equal.append(int(path.name))


def _compare_rows(before: Json, now: Json) -> None:
    for name in sorted((before.keys() | now.keys()) - set(TIMES)):
        if before.get(name) != now.get(name):
            raise _Differs(f"metrics.jsonl, step {before['steps']}, {name}: {before.get(name)} in the run, {now.get(name)} when made again")


def _compare_array(where: str, before: np.ndarray | None, now: np.ndarray | None) -> None:
    if before is None or now is None:
        raise _Differs(f"{where}: only {'the run' if now is None else 'what was made again'} has it")
    if before.shape != now.shape or before.dtype != now.dtype:
        raise _Differs(f"{where}: {before.dtype}{list(before.shape)} in the run, {now.dtype}{list(now.shape)} when made again")
    if before.tobytes() == now.tobytes():
        return
    # By bytes: equal NaNs are equal, and 0 is not -0.
    width = before.dtype.itemsize
    rows = (np.frombuffer(array.tobytes(), np.uint8).reshape(-1, width) for array in (before, now))
    unequal = np.flatnonzero((next(rows) != next(rows)).any(axis=1))
    first = unequal[0]
    raise _Differs(
        f"{where}: {len(unequal)} of {before.size} numbers differ, the first: {before.ravel()[first]!s} in the run, "
        f"{now.ravel()[first]!s} when made again"
    )


def _readable(name: str) -> str:
    part, _, rest = name.partition("/")
    return f"{_PARTS.get(part, part)}/{rest}"


def _nothing(carry: Carry, points: Sequence[LogPoint]) -> None:
    """No policy is exported."""
