"""A run of a learner of language models: steps, a log, checkpoints to go on from bit for bit, the model as a folder at the end.

The directory: ``run.json`` (what was asked for), ``metrics.jsonl`` and TensorBoard's events, ``checkpoints/<step>``, ``model/``. A command
that is given again goes on where it stopped.
"""

import hashlib
import json
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import PyTree

from thorndike.errors import UserError
from thorndike.language.decoder import Params
from thorndike.language.learner import Learner, State
from thorndike.training.checkpoints import newest
from thorndike.training.json_files import Json, as_bytes, parse_object
from thorndike.training.progress import Progress
from thorndike.training.run_directory import append_lines, checkpoints, facts, read_run, truncate_lines, write_json
from thorndike.training.run_lock import run_lock
from thorndike.training.sealed_folders import NewFolder, SealedFolder, discard
from thorndike.training.stopping import saving, stop_requests
from thorndike.training.tensorboard import EventWriter
from thorndike.training.tree_files import read_tree, write_tree
from thorndike.types import Metrics

METRICS, MODEL, ADAPTER = "metrics.jsonl", "model", "adapter"
_STATE, _PROGRESS = "state", "progress.json"
_KEPT = 2


class TextPlan(NamedTuple):
    """How long, and how often things happen, in gradient steps."""

    steps: int
    log_every: int = 10
    checkpoint_every: int = 200


class TextOutcome(NamedTuple):
    """How a run ended."""

    run: Path
    status: str
    """``finished`` or ``interrupted``."""
    steps: int
    state: State
    wall_s: float
    cpu_s: float


def open_run(run: Path, request: Mapping[str, object], files: Sequence[Path] = ()) -> None:
    """Make a run's directory, or find it there with the same request, and ``files`` of data with the same content.

    Raises ``UserError`` for another request, and for a file that has changed; runs of older versions do not know what was in them.
    """
    asked = json.loads(json.dumps(request))
    if not (run / "run.json").exists():
        if run.exists() and any(run.iterdir()):
            raise UserError(f"{run} is there already and is no run: choose another folder")
        run.mkdir(parents=True, exist_ok=True)
        write_json(run / "run.json", facts() | {"kind": "language", "request": asked, "files": _digests(files)})
        return
    found = read_run(run)
    before, known = found.get("request"), found.get("files")
    if isinstance(known, dict):  # First, because settings that are left out follow from the number of rows.
        for name, digest in _digests(files).items():
            if known.get(name, digest) != digest:
                raise UserError(f"{name} has changed since {run} was begun: put back what was in it to go on, or choose another folder")
    if before != asked:
        old = before if isinstance(before, dict) else {}
        changed = sorted(name for name in {*old, *asked} if old.get(name) != asked.get(name))
        raise UserError(f"{run} was begun with another {', '.join(changed)}: give what it was begun with to go on, or another folder")


def _digests(files: Sequence[Path]) -> dict[str, str]:
    """Each file's absolute path -> the SHA-256 of its content."""
    found = {}
    for path in files:
        with path.open("rb") as file:
            found[str(path.absolute())] = hashlib.file_digest(file, "sha256").hexdigest()
    return found


def run_learner(
    run: Path,
    learner: Learner,
    params: Params,
    batch: Callable[[int, State], PyTree],
    plan: TextPlan,
    seed: int,
    *,
    evaluate: Callable[[State], Mapping[str, float]] | None = None,
    progress: bool = True,
) -> TextOutcome:
    """Learn to the end of the plan, or to an interruption, from the newest checkpoint if there is one.

    ``batch(step, state)`` must depend on nothing else, or the run would not be the same when it goes on. ``evaluate`` adds figures to the
    log whenever a checkpoint is written. Raises ``UserError`` where the loss is no longer finite.
    """
    frozen = jax.tree.map(jax.numpy.asarray, learner.frozen(params))
    update = jax.jit(learner.update, donate_argnums=0)
    state, before = _begin(run, learner, params, seed)
    step = int(state.step)
    log = _Log(run, before)
    waiting: list[Metrics] = []
    with ExitStack() as stack:
        stack.enter_context(run_lock(run))
        stack.callback(log.close)
        bar = stack.enter_context(Progress(plan.steps, progress, done_steps=step))
        stopped = stack.enter_context(stop_requests())
        while step < plan.steps and stopped() is None:
            state, metrics = update(state, frozen, batch(step, state))
            step += 1
            waiting.append(metrics)
            due = step % plan.checkpoint_every == 0 or step == plan.steps
            if due or step % plan.log_every == 0:
                log.write(step, waiting, evaluate(state) if due and evaluate is not None else {})
                waiting = []
                bar.update(step)
            if due:
                _save(run, state, log)
        if step < plan.steps:
            if waiting:
                log.write(step, waiting, {})
            _save(run, state, log)
    return TextOutcome(run, "finished" if step >= plan.steps else "interrupted", step, state, log.wall_s, log.cpu_s)


class _Log:
    """The means of each stretch of steps, as JSON lines and for TensorBoard."""

    def __init__(self, run: Path, before: tuple[float, float]) -> None:
        """``before``: wall and CPU seconds of earlier sessions."""
        self._path, self._before = run / METRICS, before
        self._began = (time.perf_counter(), time.process_time())
        self._events = EventWriter(run)

    @property
    def wall_s(self) -> float:
        """Seconds of all sessions."""
        return self._before[0] + time.perf_counter() - self._began[0]

    @property
    def cpu_s(self) -> float:
        """CPU seconds of all sessions."""
        return self._before[1] + time.process_time() - self._began[1]

    def write(self, step: int, metrics: list[Metrics], more: Mapping[str, float]) -> None:
        """Fetch and log. Raises ``UserError`` for a number that is not finite."""
        fetched = jax.device_get(metrics)
        values = {name: float(np.mean([each[name] for each in fetched])) for name in fetched[0]} | dict(more)
        for name, value in values.items():
            if not np.isfinite(value):
                raise UserError(f"{name} is not finite by step {step}: training stopped, the last checkpoint is kept; lower learning_rate")
        append_lines(self._path, [{"steps": step, "wall_s": self.wall_s, "cpu_s": self.cpu_s, **values}])
        for name, value in values.items():
            self._events.scalar(name, value, step)
        self._events.flush()

    def close(self) -> None:
        """Close the file of events."""
        self._events.close()


def _begin(run: Path, learner: Learner, params: Params, seed: int) -> tuple[State, tuple[float, float]]:
    """The state to go on from, and the seconds spent so far."""
    fresh = learner.init(params, jax.random.key(seed))
    if not checkpoints(run):
        truncate_lines(run / METRICS, 0)
        return fresh, (0.0, 0.0)

    def read(folder: SealedFolder) -> tuple[State, Json]:
        return read_tree(fresh, folder, _STATE), parse_object(folder.read(_PROGRESS), folder.path / _PROGRESS)

    state, told = newest(run, read)
    truncate_lines(run / METRICS, int(state.step))
    wall, cpu = (value if isinstance(value, float) else 0.0 for value in (told.get("wall_s"), told.get("cpu_s")))
    return jax.tree.map(jax.numpy.asarray, state), (wall, cpu)


def _save(run: Path, state: State, log: _Log) -> None:
    folder = run / "checkpoints"
    folder.mkdir(exist_ok=True)
    with saving():
        new = NewFolder(folder / "partial")
        write_tree(state, new, _STATE)
        new.write(_PROGRESS, as_bytes({"wall_s": log.wall_s, "cpu_s": log.cpu_s}))
        new.publish(folder / str(int(state.step)))
        for path in checkpoints(run)[:-_KEPT]:
            discard(path)
