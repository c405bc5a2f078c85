"""Where the time of training on a host engine goes: environment, acting, learning, waiting.

Python's own clock around calls that are made anyway: nothing waits for the device that would not wait without it.
"""

import time
from typing import NamedTuple


class Timer:
    """Seconds spent within ``with`` blocks, added up."""

    def __init__(self) -> None:
        """Nothing spent yet."""
        self.seconds = 0.0

    def __enter__(self) -> None:
        """Begin."""
        self._began = time.perf_counter()

    def __exit__(self, *raised: object) -> None:
        """End."""
        self.seconds += time.perf_counter() - self._began


class Clock:
    """What a pool of environments knows of its time."""

    def __init__(self) -> None:
        """Nothing spent yet."""
        self.environment = Timer()
        """In the engine."""
        self.waiting = Timer()
        """Until the device had the actions: it decides on them, and before that it ends the update that is under way."""


class Shares(NamedTuple):
    """Of the time that a segment took. What is missing to 1 is the loop's own: random numbers, sums of episodes."""

    environment: float
    acting: float
    """Python's part of acting: dispatching decisions, wrappers, gathering rows."""
    learning: float
    """The call of the update; where the device works on while Python goes on, most of it is waited for in the next rollout."""
    waiting: float


class SegmentTimes:
    """The seconds of a segment."""

    def __init__(self, clock: Clock) -> None:
        """``clock``: of the pool that the segment steps."""
        self._clock, self._before = clock, (clock.environment.seconds, clock.waiting.seconds)
        self._began, self._collecting, self._learning = time.perf_counter(), 0.0, 0.0

    def add(self, collecting: float, learning: float) -> None:
        """Seconds of one iteration."""
        self._collecting += collecting
        self._learning += learning

    def shares(self) -> Shares:
        """Up to now."""
        now = self._clock.environment.seconds, self._clock.waiting.seconds
        environment, waiting = (after - before for after, before in zip(now, self._before, strict=True))
        whole = max(time.perf_counter() - self._began, 1e-9)
        seconds = environment, self._collecting - environment - waiting, self._learning, waiting
        return Shares(*(part / whole for part in seconds))
