"""A program that is asked questions line by line, and may die, hang or babble: started, asked with a limit, and always ended."""

import contextlib
import os
import queue
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Sequence

from thorndike.games.game import Stopped

_GRACE_S = 1.0
"""Between asking a program to leave and ending it."""
_LOOK_EVERY_S = 0.1
_LONGEST_LINE = 100_000
_WAITING_LINES = 1000


class EngineFailure(Exception):
    """The program ended, or did not answer in time; the message says which."""


class EngineProcess:
    """One program, in a process group of its own: a Ctrl-C meant for us does not reach it, and what it starts is ended with it."""

    def __init__(self, command: Sequence[str]) -> None:
        """Start it. Raises ``EngineFailure`` if that cannot be done."""
        try:
            self._process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, start_new_session=True
            )
        except OSError as error:
            raise EngineFailure(f"cannot be started: {error.strerror}") from error
        self._lines: queue.Queue[str | None] = queue.Queue(_WAITING_LINES)
        self._ended = False
        self.stopped: Callable[[], bool] = lambda: False
        """Asked while an answer is waited for."""
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        # Neither a line that never ends nor lines without end fill the memory: the program waits until they are read.
        with contextlib.suppress(ValueError):
            while line := self._process.stdout.readline(_LONGEST_LINE):
                self._lines.put(line.decode(errors="replace").rstrip("\r\n"))
        self._lines.put(None)

    def send(self, line: str) -> None:
        """Raises ``EngineFailure`` if the program has gone."""
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(f"{line}\n".encode())
            self._process.stdin.flush()
        except (OSError, ValueError) as error:
            raise EngineFailure("ended unexpectedly") from error

    def line(self, until: float) -> str:
        """The next line, by ``time.monotonic()`` ``until``. Raises ``EngineFailure`` if there is none, ``Stopped`` if none is wanted."""
        if self._ended:
            raise EngineFailure("ended unexpectedly")
        found = self._waited_for(until)
        if found is None:
            self._ended = True
            raise EngineFailure("ended unexpectedly")
        return found

    def _waited_for(self, until: float) -> str | None:
        while not self.stopped():
            left = max(until - time.monotonic(), 0)
            try:
                return self._lines.get(timeout=min(left, _LOOK_EVERY_S))
            except queue.Empty:
                if left <= _LOOK_EVERY_S:
                    raise EngineFailure("did not answer in time") from None
        raise Stopped

    def close(self, farewell: str = "quit") -> None:
        """Ask it to leave, then make it; afterwards there is no process of it, not even a dead one."""
        with contextlib.suppress(EngineFailure):
            self.send(farewell)
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_GRACE_S)
        # What it started may outlive it.
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        # The reader may be waiting for room.
        while self._reader.is_alive():
            with contextlib.suppress(queue.Empty):
                self._lines.get(timeout=0.01)
        for pipe in (self._process.stdin, self._process.stdout):
            with contextlib.suppress(OSError):
                if pipe is not None:
                    pipe.close()
