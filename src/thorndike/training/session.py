"""From the first iteration of a run, or its last checkpoint, to the end: segments, logs, checkpoints, the exported policy."""

from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import PyTree

from thorndike.errors import UserError
from thorndike.training.checkpoints import START, Progressed, restore, save_checkpoint
from thorndike.training.host_source import HostSource
from thorndike.training.metrics import LogPoint, MetricsLog
from thorndike.training.notices import notice
from thorndike.training.progress import Progress
from thorndike.training.run_directory import refuse_if_gone
from thorndike.training.runner import Runner
from thorndike.training.segment import Carry, Report
from thorndike.training.stopping import saving, stop_requests

FIRST_LOOK, LOOK_EVERY = 10, 5
"""In log points; there are a hundred in a run."""
RECENT = 10
"""Log points over which the best seed is chosen: a tenth of a run."""


class Plan(NamedTuple):
    """How long, and how often things happen, in iterations."""

    iterations: int
    log_every: int
    checkpoint_every: int
    also: tuple[int, ...] = ()
    """Further iterations, rising, at which a line is logged and a checkpoint is due."""

    def looks(self, iteration: int) -> bool:
        """Whether learning dynamics are logged at an iteration: at every fifth log point from the tenth on.

        Late and seldom, so that a short run never compiles what it takes, and a long one spends next to nothing on it.
        """
        point, rest = divmod(iteration, self.log_every)
        return rest == 0 and point >= FIRST_LOOK and point % LOOK_EVERY == 0

    def next_stop(self, iteration: int) -> int:
        """Where the segment that begins at an iteration ends."""
        return min(_next(iteration, self.log_every), _next(iteration, self.checkpoint_every), self.iterations, *self._later(iteration))

    def keeps(self, iteration: int) -> bool:
        """Whether a checkpoint is due at an iteration."""
        return iteration % self.checkpoint_every == 0 or iteration == self.iterations or iteration in self.also

    def _later(self, iteration: int) -> tuple[int, ...]:
        return tuple(each for each in self.also if each > iteration)[:1]


class Start(NamedTuple):
    """Where a session begins."""

    carry: Carry
    progressed: Progressed = START
    recent: Sequence[LogPoint] = ()
    """The last log points before it in which episodes ended."""

    def later(self, wall_s: float, cpu_s: float) -> "Start":
        """The same, so many seconds having been spent."""
        before = self.progressed
        return self._replace(progressed=before._replace(wall_s=before.wall_s + wall_s, cpu_s=before.cpu_s + cpu_s))


class Keeping(NamedTuple):
    """What is done with the state of a run where a checkpoint is due. Both raise ``OSError`` where the disk refuses."""

    save: Callable[[Carry, Progressed], None]
    export: Callable[[Carry, Sequence[LogPoint]], None]


class Outcome(NamedTuple):
    """How a session ended."""

    status: str
    """``finished`` or ``interrupted``."""
    steps: int
    saved_steps: int
    """What the newest checkpoint holds: a resumed run goes on from there."""
    signal: int | None
    """What interrupted it."""
    wall_s: float
    cpu_s: float
    recent: Sequence[LogPoint]
    """The last log points in which episodes ended."""


def run_session(run: Path, runner: Runner, source: PyTree, plan: Plan, start: Start, keeping: Keeping, bar: Progress) -> Outcome:
    """Train to the end of ``plan``, or to an interruption. Metrics are fetched one segment late, so that the device never waits.

    Where the disk refuses, training goes on and tries again at the next checkpoint. Raises ``UserError`` if the last one fails too, or
    the run's directory is gone.
    """
    session = _Session(run, runner, source, plan, start, keeping, bar)
    try:
        with stop_requests() as stopped:
            session.train(stopped)
            signal = stopped()
    finally:
        session.log.close()
    session.keeper.complain()
    steps, saved = (number * runner.steps_per_iteration for number in (session.iteration, session.keeper.saved))
    if session.iteration >= plan.iterations:
        return Outcome("finished", steps, saved, None, session.log.wall_s, session.log.cpu_s, tuple(session.recent))
    if saved < steps:
        notice(f"the state of host environments is saved at checkpoints only: resume goes on from step {saved}, not from {steps}")
    return Outcome("interrupted", steps, saved, signal, session.log.wall_s, session.log.cpu_s, tuple(session.recent))


class _Session:
    """A session under way."""

    def __init__(self, run: Path, runner: Runner, source: PyTree, plan: Plan, start: Start, keeping: Keeping, bar: Progress) -> None:
        """At its beginning."""
        self.carry, self.iteration = start.carry, start.progressed.iteration
        self.recent = deque(start.recent, maxlen=RECENT)
        self.log = MetricsLog(run, start.progressed.wall_s, start.progressed.cpu_s)
        self.keeper = _Keeper(run, keeping, self.log, self.recent, self.iteration)
        self._runner, self._plan, self._bar = runner, plan, bar
        self._on_host = isinstance(source, HostSource)
        self._waiting: tuple[Report, int] | None = None

    def train(self, stopped: Callable[[], int | None]) -> None:
        """Segment after segment, to the end of the plan or until ``stopped``."""
        self.keeper.renew_policy(self.carry)
        while self.iteration < self._plan.iterations and stopped() is None and self._advance(stopped):
            if self._plan.keeps(self.iteration):
                self._settle()
                self.keeper.keep(self.carry, self.iteration)
        self._settle()
        if self.iteration < self._plan.iterations and not self._on_host:
            self.keeper.keep(self.carry, self.iteration)

    def _advance(self, stopped: Callable[[], int | None]) -> bool:
        """One segment; False if host environments died in it of the signal that the keyboard sends to their processes too."""
        until = self._plan.next_stop(self.iteration)
        try:
            self.carry, report = self._runner.advance(self.carry, self.iteration, until - self.iteration)
        except Exception:
            if stopped() is None or not self._on_host:
                raise
            return False
        if self._plan.looks(until) and self._runner.dynamics is not None:
            report = report._replace(metrics=report.metrics | self._runner.dynamics(self.carry, until))
        self._settle()
        self._waiting, self.iteration = (report, until * self._runner.steps_per_iteration), until
        return True

    def _settle(self) -> None:
        """Fetch the report that is waiting, log and show it."""
        if self._waiting is None:
            return
        point = self.log.write(*self._waiting)
        self._waiting = None
        _check_finite(point)
        _show(self._bar, point, self.log.wall_s)
        if point.returns:
            self.recent.append(point)


class _Keeper:
    """Keeps the state of a run where it is due, as far as the disk lets it."""

    def __init__(self, run: Path, keeping: Keeping, log: MetricsLog, recent: deque[LogPoint], saved: int) -> None:
        """``saved``: the iteration of the newest checkpoint."""
        self.saved = saved
        self._run, self._keeping, self._log, self._recent = run, keeping, log, recent
        self._error: OSError | None = None

    def keep(self, carry: Carry, iteration: int) -> None:
        """Write a checkpoint and the policy. The log comes first: what a checkpoint holds, the log has told."""
        if iteration == self.saved:
            return
        try:
            with saving():
                self._log.sync()
                self._keeping.save(carry, Progressed(iteration, self._log.wall_s, self._log.cpu_s))
                self.saved = iteration
                self._keeping.export(carry, tuple(self._recent))
        except OSError as error:
            refuse_if_gone(self._run)
            notice(f"a checkpoint of {self._run} could not be written: {error.strerror}; training goes on and tries again at the next one")
            self._error = error
        else:
            self._error = None

    def renew_policy(self, carry: Carry) -> None:
        """Of a run that goes on: it may have been stopped between writing the checkpoint and the policy, or the policy was damaged."""
        if self.saved == 0:
            return
        try:
            self._keeping.export(carry, tuple(self._recent))
        except OSError as error:
            notice(f"the policy in {self._run} could not be written: {error.strerror}; it is tried again at the next checkpoint")

    def complain(self) -> None:
        """Raises ``UserError`` if the last attempt failed."""
        if self._error is not None:
            raise UserError(
                f"the last checkpoint of {self._run} could not be written: {self._error.strerror}; mend that (free some space), "
                f"then go on from the one before it: thorndike resume {self._run}"
            ) from self._error


class NotFinite(UserError):
    """A learner's numbers are no longer finite; ``steps``: by when."""

    def __init__(self, message: str, steps: int) -> None:
        super().__init__(message)
        self.steps = steps


def _check_finite(point: LogPoint) -> None:
    """Raises ``NotFinite`` for a learner whose numbers are no longer finite: nothing is saved over the last good checkpoint."""
    for name, values in point.values.items():
        if name.startswith("train/") and None in values:
            raise NotFinite(
                f"{name} of seed {values.index(None)} is not finite by step {point.steps}: training stopped, the last checkpoint is kept; "
                "lower learning_rate, or normalise rewards and observations",
                point.steps,
            )


def _next(iteration: int, every: int) -> int:
    return (iteration // every + 1) * every


def _show(bar: Progress, point: LogPoint, wall_s: float) -> None:
    returns, seeds = point.returns, len(point.values["rollout/episodes"])
    interval = None if len(returns) < 2 else _interval(returns)
    bar.update(point.steps, float(np.mean(returns)) if returns else None, interval, seeds * point.steps / max(wall_s, 1e-9))


def _interval(returns: list[float]) -> tuple[float, float]:
    """95 % normal interval of the mean over seeds: for the eye, while training."""
    half = 1.96 * float(np.std(returns, ddof=1)) / len(returns) ** 0.5
    return float(np.mean(returns)) - half, float(np.mean(returns)) + half


__all__ = ["RECENT", "START", "Keeping", "Outcome", "Plan", "Progressed", "Start", "restore", "run_session", "save_checkpoint"]
