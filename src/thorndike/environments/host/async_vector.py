"""Gymnasium's ``AsyncVectorEnv``, where a user gives one: calls with time-outs, and what went wrong in which process."""

import multiprocessing
from collections.abc import Sequence
from multiprocessing.connection import Connection

import numpy as np
from gymnasium.vector import AsyncVectorEnv

from thorndike.environments.host.faults import Fault, gone, hung, one_line
from thorndike.types import Observation

_MOMENT = 0.2
"""Seconds in which a process whose pipe has closed is known to be dead."""


def reset_within(vector: AsyncVectorEnv, seconds: float, seeds: Sequence[int] | None, options: dict | None = None) -> Observation:
    """First observations ``[B, ...]``."""
    vector.reset_async(seed=None if seeds is None else list(seeds), options=options)
    return vector.reset_wait(timeout=seconds)[0]


def step_within(
    vector: AsyncVectorEnv, seconds: float, actions: np.ndarray
) -> tuple[Observation, np.ndarray, np.ndarray, np.ndarray, dict[str, object]]:
    """What ``vector.step`` gives, automatic resets included."""
    vector.step_async(actions)
    return vector.step_wait(timeout=seconds)


def worker_fault(vector: AsyncVectorEnv, error: Exception, seconds: float) -> Fault | None:
    """Which process failed and how, as far as `error` and the processes tell."""
    if isinstance(error, multiprocessing.TimeoutError):
        row = next((row for row, pipe in enumerate(vector.parent_pipes) if not _is_ready(pipe)), 0)
        return hung(seconds, row)
    if isinstance(error, EOFError | OSError):
        return _dead_worker(vector)
    # Gymnasium drops the pipe of a process that raised, and shows the traceback itself.
    row = next((row for row, pipe in enumerate(vector.parent_pipes) if pipe is None), -1)
    return None if row < 0 else Fault(f"raised {type(error).__name__}: {one_line(error)}", "mend it there", row)


def end(vector: AsyncVectorEnv) -> None:
    """Kill the processes: ``close`` would wait for those that hang."""
    for process in vector.processes:
        process.kill()
    for process, pipe in zip(vector.processes, vector.parent_pipes, strict=True):
        process.join(_MOMENT)
        if pipe is not None:
            pipe.close()
    vector.closed = True


def _is_ready(pipe: Connection | None) -> bool:
    return pipe is not None and not pipe.closed and pipe.poll(0)


def _dead_worker(vector: AsyncVectorEnv) -> Fault | None:
    for row, process in enumerate(vector.processes):
        process.join(_MOMENT)
        if process.exitcode is not None:
            return gone(process.exitcode, row)
    return None
