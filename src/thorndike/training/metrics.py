"""The log of a run: one JSON line a log point with the seed axis kept, and TensorBoard events beside it."""

import time
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from thorndike.training.run_directory import append_lines
from thorndike.training.runner import Report
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
    """Appends log points to metrics.jsonl and the mean over seeds to a TensorBoard file."""

    def __init__(self, run: Path, wall_before: float, cpu_before: float) -> None:
        """``*_before`` are the seconds spent by the sessions before this one."""
        self._path = run / "metrics.jsonl"
        self._events = EventWriter(run)
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
        metrics, episodes = jax.tree.map(np.asarray, tuple(report))
        values = {name: _numbers(value) for name, value in sorted(metrics.items())}
        with np.errstate(divide="ignore", invalid="ignore"):
            values["rollout/ep_rew_mean"] = _numbers(episodes.return_sum / episodes.episodes)
            values["rollout/ep_len_mean"] = _numbers(episodes.length_sum / episodes.episodes)
        values["rollout/episodes"] = _numbers(episodes.episodes)
        point = LogPoint(steps, self.wall_s, self.cpu_s, values)
        fps = self._steps_per_second(point)
        append_lines(self._path, [{"steps": steps, "wall_s": point.wall_s, "cpu_s": point.cpu_s, "time/fps": fps, **values}])
        for name, numbers in values.items():
            finite = [number for number in numbers if number is not None]
            if finite:
                self._events.scalar(name, float(np.mean(finite)), steps)
        if fps is not None:
            self._events.scalar("time/fps", fps, steps)
        self._events.flush()
        return point

    def _steps_per_second(self, point: LogPoint) -> float | None:
        """Steps of all seeds per second since the last log point."""
        last, self._last = self._last, (point.steps, point.wall_s)
        if last is None or point.wall_s <= last[1]:
            return None
        seeds = len(point.values["rollout/episodes"])
        return seeds * (point.steps - last[0]) / (point.wall_s - last[1])

    def close(self) -> None:
        """Close the event file."""
        self._events.close()


def _numbers(values: np.ndarray) -> list[float | None]:
    return [float(value) if np.isfinite(value) else None for value in np.asarray(values, np.float64)]
