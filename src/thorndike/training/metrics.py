"""The log of a run: one JSON line a log point with the seed axis kept, and TensorBoard events beside it."""

import time
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple, cast

import jax
import numpy as np

from thorndike.training.json_files import Json
from thorndike.training.notices import notice
from thorndike.training.run_directory import append_lines, read_lines, refuse_if_gone
from thorndike.training.sealed_folders import flush
from thorndike.training.segment import Report
from thorndike.training.tensorboard import EventWriter


class LogPoint(NamedTuple):
    """What was logged: lists have one number a seed."""

    steps: int
    wall_s: float
    cpu_s: float
    values: dict[str, list[float | None]]

    @property
    def returns(self) -> list[float]:
        """Mean episode return of the seeds that finished an episode in this segment."""
        return [value for value in self.values["rollout/ep_rew_mean"] if value is not None]


class MetricsLog:
    """Appends log points to metrics.jsonl and the mean over seeds to a TensorBoard file.

    Lines that cannot be written (the disk is full) wait until they can; the TensorBoard file, which says nothing new, is given up.
    """

    def __init__(self, run: Path, wall_before: float, cpu_before: float) -> None:
        """``*_before`` are the seconds spent by the sessions before this one."""
        self._path = run / "metrics.jsonl"
        self._unwritten: list[Json] = []
        self._told = False
        self._events = _event_writer(run)
        self._wall_before, self._cpu_before = wall_before, cpu_before
        self._wall_start, self._cpu_start = time.perf_counter(), time.process_time()
        self._last: tuple[int, float] | None = None

    @property
    def wall_s(self) -> float:
        """Seconds of all sessions of this run."""
        return self._wall_before + time.perf_counter() - self._wall_start

    @property
    def cpu_s(self) -> float:
        """CPU seconds of all sessions of this run, this process's only."""
        return self._cpu_before + time.process_time() - self._cpu_start

    def write(self, report: Report, steps: int) -> LogPoint:
        """Fetch a segment's report (waiting for it if need be) and log it as of ``steps`` environment steps a seed."""
        metrics, episodes = jax.tree.map(np.asarray, (report.metrics, report.episodes))
        values = {name: _numbers(value) for name, value in sorted(metrics.items())}
        with np.errstate(divide="ignore", invalid="ignore"):
            values["rollout/ep_rew_mean"] = _numbers(episodes.return_sum / episodes.episodes)
            values["rollout/ep_len_mean"] = _numbers(episodes.length_sum / episodes.episodes)
        values["rollout/episodes"] = _numbers(episodes.episodes)
        point = LogPoint(steps, self.wall_s, self.cpu_s, values)
        shares = {} if report.shares is None else report.shares._asdict()
        times = {"time/fps": self._steps_per_second(point), **{f"time/{name}": share for name, share in shares.items()}}
        self._unwritten.append({"steps": steps, "wall_s": point.wall_s, "cpu_s": point.cpu_s, **times, **values})
        try:
            self._append()
        except OSError as error:
            self._tell(error)
        self._mirror(point, times)
        return point

    def sync(self) -> None:
        """Make all lines durable. Raises ``OSError`` if they cannot be written."""
        self._append()
        flush(self._path)

    def _append(self) -> None:
        append_lines(self._path, self._unwritten)
        self._unwritten.clear()

    def _tell(self, error: OSError) -> None:
        refuse_if_gone(self._path.parent)
        if not self._told:
            notice(f"{self._path} cannot be written: {error.strerror}; training goes on, the lines are kept and written once they can be")
        self._told = True

    def _mirror(self, point: LogPoint, times: dict[str, float | None]) -> None:
        """The means over seeds, for TensorBoard."""
        if self._events is None:
            return
        means = {name: [number for number in numbers if number is not None] for name, numbers in point.values.items()}
        try:
            for name, finite in [*means.items(), *((name, [] if value is None else [value]) for name, value in times.items())]:
                if finite:
                    self._events.scalar(name, float(np.mean(finite)), point.steps)
            self._events.flush()
        except OSError as error:
            notice(f"{self._events.path} cannot be written: {error.strerror}; training goes on without TensorBoard's file")
            self._give_up_events()

    def _give_up_events(self) -> None:
        if self._events is not None:
            # What it still holds in memory cannot be written either.
            with suppress(OSError):
                self._events.close()
        self._events = None

    def _steps_per_second(self, point: LogPoint) -> float | None:
        """Steps of all seeds per second since the last log point."""
        last, self._last = self._last, (point.steps, point.wall_s)
        if last is None or point.wall_s <= last[1]:
            return None
        seeds = len(point.values["rollout/episodes"])
        return seeds * (point.steps - last[0]) / (point.wall_s - last[1])

    def close(self) -> None:
        """Close the event file."""
        self._give_up_events()


def _event_writer(run: Path) -> EventWriter | None:
    try:
        return EventWriter(run)
    except OSError as error:
        notice(f"{run} cannot be written: {error.strerror}; training goes on without TensorBoard's file")
        return None


def last_points(run: Path, number: int, seeds: int) -> list[LogPoint]:
    """The last log points of a run in which episodes ended."""
    rows = [row for row in read_lines(run / "metrics.jsonl") if _is_point(row, seeds)]
    lists = [{name: values for name, values in row.items() if isinstance(values, list)} for row in rows]
    points = [LogPoint(int(cast(float, row["steps"])), 0.0, 0.0, values) for row, values in zip(rows, lists, strict=True)]
    return [point for point in points if point.returns][-number:]


def _is_point(row: Json, seeds: int) -> bool:
    returns = row.get("rollout/ep_rew_mean")
    return isinstance(returns, list) and len(returns) == seeds and all(value is None or type(value) in (int, float) for value in returns)


def _numbers(values: np.ndarray) -> list[float | None]:
    return [float(value) if np.isfinite(value) else None for value in np.asarray(values, np.float64)]
