"""What one contestant process measures of itself; standard library only, so that it costs no contestant an import."""

import json
import resource
import sys
import time
from dataclasses import dataclass


def cpu_seconds() -> float:
    """User + system CPU-seconds of this process since it started: its threads and its finished children included."""
    own = resource.getrusage(resource.RUSAGE_SELF)
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return own.ru_utime + own.ru_stime + children.ru_utime + children.ru_stime


def peak_memory_mb() -> float:
    """Largest resident set of this process so far, in MiB (Linux reports KiB)."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


@dataclass(frozen=True)
class Moment:
    """A point in time: wall seconds of the system's monotonic clock, CPU-seconds of this process, environment steps done."""

    wall: float
    cpu: float
    steps: int


def now(steps: int = 0) -> Moment:
    """The present moment, after ``steps`` environment steps."""
    return Moment(time.monotonic(), cpu_seconds(), steps)


def window(start: Moment, end: Moment) -> dict[str, float]:
    """Steps, wall and CPU-seconds between two moments."""
    return {"steps": end.steps - start.steps, "wall_s": end.wall - start.wall, "cpu_s": end.cpu - start.cpu}


def report(**fields: object) -> None:
    """Print the one JSON line that ``run.py`` reads; peak memory and the process's total CPU are added here."""
    line = {"peak_memory_mb": peak_memory_mb(), "total_cpu_s": cpu_seconds(), **fields}
    sys.stdout.write(json.dumps(line) + "\n")
    sys.stdout.flush()
