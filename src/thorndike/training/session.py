"""From the first iteration of a run, or its last checkpoint, to the end: segments, logs, checkpoints, the exported policy."""

import json
import shutil
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import PyTree

from thorndike.errors import UserError
from thorndike.training.host_source import HostSource
from thorndike.training.metrics import LogPoint, MetricsLog
from thorndike.training.progress import Progress
from thorndike.training.run_directory import checkpoints, intact, publish, truncate_lines
from thorndike.training.runner import Carry, Report, Runner
from thorndike.training.tree_files import load_tree, save_tree

_RECENT = 10
"""Log points over which the best seed is chosen: a tenth of a run."""
_KEPT = 2
"""Checkpoints kept: the newest, and one before it should the newest be lost."""


class Plan(NamedTuple):
    """How long, and how often things happen, in iterations."""

    iterations: int
    log_every: int
    checkpoint_every: int


class Progressed(NamedTuple):
    """Where a run stands."""

    iteration: int
    wall_s: float
    cpu_s: float


class Outcome(NamedTuple):
    """How a session ended."""

    status: str
    """``finished`` or ``interrupted``."""
    carry: Carry
    steps: int
    wall_s: float
    cpu_s: float
    recent: Sequence[LogPoint]
    """The last log points in which episodes ended."""


START = Progressed(0, 0.0, 0.0)


def run_session(
    run: Path,
    runner: Runner,
    source: PyTree,
    plan: Plan,
    carry: Carry,
    progressed: Progressed,
    export: Callable[[Carry, Sequence[LogPoint]], None],
    bar: Progress,
) -> Outcome:
    """Train to the end of ``plan``, or to an interruption. Metrics are fetched one segment late, so that the device never waits."""
    log = MetricsLog(run, progressed.wall_s, progressed.cpu_s)
    iteration = progressed.iteration
    waiting: tuple[Report, int] | None = None
    recent: deque[LogPoint] = deque(maxlen=_RECENT)

    def settle(waiting: tuple[Report, int] | None) -> None:
        if waiting is None:
            return
        point = log.write(*waiting)
        _check_finite(point)
        seeds = len(point.values["rollout/episodes"])
        returns = point.returns
        interval = None if len(returns) < 2 else _interval(returns)
        bar.update(waiting[1], float(np.mean(returns)) if returns else None, interval, seeds * waiting[1] / max(log.wall_s, 1e-9))
        if returns:
            recent.append(point)

    with _stop_on_signals() as stopped:
        while iteration < plan.iterations and not stopped():
            until = min(_next(iteration, plan.log_every), _next(iteration, plan.checkpoint_every), plan.iterations)
            carry, report = runner.advance(carry, iteration, until - iteration)
            settle(waiting)
            waiting, iteration = (report, until * runner.steps_per_iteration), until
            if iteration % plan.checkpoint_every == 0 or iteration == plan.iterations:
                settle(waiting)
                waiting = None
                save_checkpoint(run, carry, source, Progressed(iteration, log.wall_s, log.cpu_s), runner.steps_per_iteration)
                export(carry, tuple(recent))
        settle(waiting)
    log.close()
    status = "finished" if iteration >= plan.iterations else "interrupted"
    if status == "interrupted" and not isinstance(source, HostSource) and iteration > 0:
        save_checkpoint(run, carry, source, Progressed(iteration, log.wall_s, log.cpu_s), runner.steps_per_iteration)
        export(carry, tuple(recent))
    return Outcome(status, carry, iteration * runner.steps_per_iteration, log.wall_s, log.cpu_s, tuple(recent))


def save_checkpoint(run: Path, carry: Carry, source: PyTree, progressed: Progressed, steps_per_iteration: int) -> None:
    """Write the whole carry aside and rename it into place; of a host source, only what can be restored."""
    folder = run / "checkpoints"
    folder.mkdir(exist_ok=True)
    aside = folder / "partial"
    if aside.exists():
        shutil.rmtree(aside)
    aside.mkdir()
    save_tree(_restorable(carry, source), aside / "state.safetensors")
    (aside / "progress.json").write_text(json.dumps(progressed._asdict()), encoding="utf-8")
    publish(aside, folder / str(progressed.iteration * steps_per_iteration))
    for old in checkpoints(run)[:-_KEPT]:
        shutil.rmtree(old)


def restore(run: Path, runner: Runner, source: PyTree) -> tuple[Carry, Progressed]:
    """The carry of the newest checkpoint that is intact, and where it stands. Later lines of the log are dropped.

    Raises ``UserError`` if there is no such checkpoint.
    """
    for folder in reversed(checkpoints(run)):
        if intact(folder):
            break
    else:
        raise UserError(f"{run} has no intact checkpoint to go on from; train again, or lower --checkpoint-every")
    progressed = Progressed(**json.loads((folder / "progress.json").read_text(encoding="utf-8")))
    fresh = runner.init()
    stored = load_tree(_restorable(fresh, source), folder / "state.safetensors")
    truncate_lines(run / "metrics.jsonl", int(folder.name))
    if not isinstance(source, HostSource):
        return fresh._replace(learner=stored[0], source=stored[1]), progressed
    return fresh._replace(learner=stored[0], source=source.restart(stored[1], progressed.iteration)), progressed


def _restorable(carry: Carry, source: PyTree) -> tuple[PyTree, PyTree]:
    return carry.learner, carry.source.statistics if isinstance(source, HostSource) else carry.source


def _check_finite(point: LogPoint) -> None:
    """Raises ``UserError`` for a learner whose numbers are no longer finite: nothing is saved over the last good checkpoint."""
    for name, values in point.values.items():
        if name.startswith("train/") and None in values:
            raise UserError(
                f"{name} of seed {values.index(None)} is not finite by step {point.steps}: training stopped, the last checkpoint is kept; "
                "lower learning_rate, or normalise rewards and observations"
            )


def _next(iteration: int, every: int) -> int:
    return (iteration // every + 1) * every


def _interval(returns: list[float]) -> tuple[float, float]:
    """95 % normal interval of the mean over seeds: for the eye, while training."""
    half = 1.96 * float(np.std(returns, ddof=1)) / len(returns) ** 0.5
    return float(np.mean(returns)) - half, float(np.mean(returns)) + half


@contextmanager
def _stop_on_signals() -> Iterator[Callable[[], bool]]:
    """Turn SIGINT and SIGTERM into a request to stop at the end of the segment; a second one acts as usual."""
    asked: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def ask(number: int, frame: object) -> None:
        asked.append(number)
        for each, handler in before.items():
            signal.signal(each, handler)

    for number in before:
        signal.signal(number, ask)
    try:
        yield lambda: bool(asked)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


__all__ = ["START", "Outcome", "Plan", "Progressed", "restore", "run_session", "save_checkpoint"]
