"""What training did."""

from pathlib import Path
from typing import NamedTuple


class Result(NamedTuple):
    """What training did."""

    run: Path
    status: str
    """``finished`` or ``interrupted``."""
    steps: int
    """Environment steps of each seed."""
    seeds: int
    wall_s: float
    cpu_s: float
    compile_s: float
    """CPU seconds of compiling, included in ``cpu_s``."""
    steps_per_s: float
    """Steps of all seeds per second, compiling left out."""
    steps_per_cpu_s: float
    mean_return: float
    """Of the episodes that ended in the last log point, over all seeds; NaN if none did."""
    saved_steps: int = 0
    """What the newest checkpoint holds: a resumed run goes on from there."""
    signal: int | None = None
    """The signal that interrupted it."""
