"""SIGINT and SIGTERM: the first asks for an orderly stop, the second acts at once, and a stop that takes too long is cut short."""

import os
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import NoReturn

SIGNALS = (signal.SIGINT, signal.SIGTERM)
GRACE_S = 4.0
"""What an orderly stop may take before the process leaves all the same: it is to be out within 5 seconds."""
_UNWIND_S = 0.5
"""The same after a second signal."""
_LOOK_AGAIN_S = 0.2
_saving = threading.Event()
"""Set while a checkpoint is written: a large replay buffer may need longer, and is worth it."""


@contextmanager
def stop_requests() -> Iterator[Callable[[], int | None]]:
    """Meanwhile the first signal is only noted; the function given says which it was. A second one acts as it did before."""
    asked: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield lambda: None
        return
    before = {number: signal.getsignal(number) for number in SIGNALS}

    def restore() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    def ask(number: int, frame: FrameType | None) -> None:
        asked.append(number)
        restore()

    for number in SIGNALS:
        signal.signal(number, ask)
    try:
        yield lambda: asked[0] if asked else None
    finally:
        restore()


@contextmanager
def saving() -> Iterator[None]:
    """While a checkpoint is written, a stop is not cut short."""
    _saving.set()
    try:
        yield
    finally:
        _saving.clear()


@contextmanager
def prompt_exit() -> Iterator[None]:
    """For a command: SIGTERM unwinds it as SIGINT does, and ``GRACE_S`` after a signal, or at the second one, the process is gone.

    Python runs signal handlers between its own instructions only; compiling, or an environment that hangs, may keep it for long. So a
    thread watches the pipe into which the system's handler writes at once.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    before, woken = {number: signal.getsignal(number) for number in SIGNALS}, signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    for number, handler in before.items():
        if handler in (signal.SIG_DFL, signal.default_int_handler):
            signal.signal(number, _unwind)
    watch = threading.Thread(target=_watch, args=(reader,), daemon=True, name="signals")
    watch.start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(woken)
        for number, handler in before.items():
            signal.signal(number, handler)
        os.close(writer)
        watch.join()
        os.close(reader)


class Terminated(SystemExit):
    """SIGTERM, as ``KeyboardInterrupt`` is SIGINT."""


def leave(status: int) -> NoReturn:
    """End the process at once, and its children."""
    if "multiprocessing" in sys.modules:
        for child in sys.modules["multiprocessing"].active_children():
            child.kill()
    for stream in (sys.stdout, sys.stderr):
        # The last: where a handler has come in the middle of another flush.
        with suppress(OSError, ValueError, RuntimeError):
            stream.flush()
    os._exit(status)


def _unwind(number: int, frame: FrameType | None) -> None:
    if _is_importing(frame):
        # Compiled modules do not survive an exception in the middle of their import: it ended 2 of 8 commands by signal 6 or 11. Nothing
        # that was begun needs to be put in order there.
        os.write(2, f"thorndike: {'terminated' if number == signal.SIGTERM else 'interrupted'}\n".encode())
        leave(128 + number)
    if number == signal.SIGINT:
        raise KeyboardInterrupt
    raise Terminated(128 + number)


def _is_importing(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False


def _watch(reader: int) -> None:
    """Until the other end of the pipe is closed, or it is time to leave."""
    asked: list[int] = []
    deadline: float | None = None
    while True:
        left = None if deadline is None else max(0.0, deadline - time.monotonic())
        if select.select([reader], [], [], left)[0]:
            told = os.read(reader, 64)
            if not told:
                return
            asked += [number for number in told if number in SIGNALS]
            if asked:
                deadline = _deadline(deadline, len(asked))
        elif len(asked) > 1 or not _saving.is_set():
            _cut_short(asked[0])
        else:
            deadline = time.monotonic() + _LOOK_AGAIN_S


def _deadline(before: float | None, signals: int) -> float:
    if before is None:
        before = time.monotonic() + GRACE_S
    return before if signals == 1 else min(before, time.monotonic() + _UNWIND_S)


def _cut_short(number: int) -> None:
    # A bar may have hidden the cursor.
    shown = "\x1b[?25h\n" if sys.stderr.isatty() else ""
    os.write(2, f"{shown}thorndike: it took too long to end in order and was cut short; a run goes on from its last checkpoint\n".encode())
    leave(128 + number)
