"""One process at a time writes a run. The lock dies with the process, however it dies."""

import fcntl
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from thorndike.errors import UserError
from thorndike.training.json_files import as_bytes
from thorndike.training.notices import notice

_NAME = "lock.json"
_ATTEMPTS, _PAUSE_S = 5, 0.04
"""Another process may hold the lock for a moment, only to see whether it is free."""
_held: set[int] = set()
"""Descriptors of the locks this process holds."""


def _let_go_in_child() -> None:
    # A lock belongs to the open file, which a forked worker shares: one that outlives its parent would keep the run locked.
    for descriptor in _held:
        os.close(descriptor)
    _held.clear()


os.register_at_fork(after_in_child=_let_go_in_child)


@contextmanager
def run_lock(run: Path) -> Iterator[None]:
    """Hold the lock of a run. Raises ``UserError`` if another process holds it, or the run cannot be written."""
    descriptor = _acquired(run / _NAME, run)
    _held.add(descriptor)
    try:
        # Who holds it is for people to read; where even this does not fit on the disk, the lock holds all the same.
        with suppress(OSError):
            os.truncate(descriptor, 0)
            os.write(descriptor, as_bytes({"process": os.getpid(), "since": time.strftime("%Y-%m-%dT%H:%M:%S%z")}))
        yield
    finally:
        with suppress(OSError):
            os.unlink(run / _NAME)
        _held.discard(descriptor)
        os.close(descriptor)


def refuse_if_locked(run: Path) -> None:
    """Raises ``UserError`` if a process is writing the run just now. It needs nothing heavy: for an answer at once."""
    try:
        descriptor = os.open(run / _NAME, os.O_RDONLY)
    except OSError:
        return
    try:
        _lock(descriptor, fcntl.LOCK_SH, run)
    finally:
        os.close(descriptor)


def _acquired(path: Path, run: Path) -> int:
    while True:
        try:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        except OSError as error:
            raise UserError(f"{run} cannot be written: {error.strerror}; copy the run to where it can be, and go on there") from error
        try:
            _lock(descriptor, fcntl.LOCK_EX, run)
            # The process that held it may have removed the file since it was opened here.
            if path.exists() and os.path.samestat(os.stat(path), os.fstat(descriptor)):
                return descriptor
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)


def _lock(descriptor: int, kind: int, run: Path) -> None:
    for attempt in range(_ATTEMPTS):
        try:
            fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
        except BlockingIOError:
            if attempt < _ATTEMPTS - 1:
                time.sleep(_PAUSE_S)
            continue
        except OSError as error:
            notice(f"{run} cannot be locked here ({error.strerror}): take care that no other process writes it")
        return
    holder = os.pread(descriptor, 200, 0).partition(b'"process": ')[2].partition(b",")[0].decode(errors="replace").strip()
    if holder.isdigit():
        raise UserError(f"process {holder} is writing {run}: wait until it ends, or stop it with: kill {holder}")
    raise UserError(f"another process is writing {run}: wait until it ends, or stop it")
