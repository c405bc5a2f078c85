"""A disk that fails, or a process that dies, at a chosen file-system call."""

import errno
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

CALLS = (
    "close",
    "fsync",
    "ftruncate",
    "link",
    "listdir",
    "lstat",
    "mkdir",
    "open",
    "rename",
    "replace",
    "rmdir",
    "scandir",
    "stat",
    "unlink",
    "write",
)


class Dead(BaseException):
    """The process was killed here."""


class Disk:
    """Counts the calls made of it; ``faults`` is asked before each whether it goes well."""

    def __init__(self, fault: Callable[["Disk", str, tuple], None]) -> None:
        self.made: list[str] = []
        self.fault = fault
        self.dead = False

    def call(self, name: str, original: Callable, arguments: tuple, named: dict) -> object:
        if self.dead:
            raise Dead
        self.made.append(name)
        self.fault(self, name, arguments)
        # Nothing here survives a loss of power: to flush would only cost time.
        return None if name == "fsync" else original(*arguments, **named)


@contextmanager
def disk(fault: Callable[[Disk, str, tuple], None] = lambda disk, name, arguments: None) -> Iterator[Disk]:
    """Meanwhile every file-system call of this process goes through a ``Disk``."""
    watched = Disk(fault)

    def through(name: str, original: Callable) -> Callable:
        return lambda *arguments, **named: watched.call(name, original, arguments, named)

    with pytest.MonkeyPatch.context() as patch:
        for name in CALLS:
            patch.setattr(os, name, through(name, getattr(os, name)))
        yield watched


def failing_at(number: int, code: int = errno.ENOSPC) -> Callable[[Disk, str, tuple], None]:
    """Call ``number`` fails; those after it go well."""

    def fault(watched: Disk, name: str, arguments: tuple) -> None:
        if len(watched.made) == number:
            raise OSError(code, os.strerror(code))

    return fault


def dying_at(number: int) -> Callable[[Disk, str, tuple], None]:
    """The process dies before call ``number``; of a write, after half of it."""
    real_write = os.write

    def fault(watched: Disk, name: str, arguments: tuple) -> None:
        if len(watched.made) == number:
            if name == "write":
                descriptor, data = arguments
                real_write(descriptor, bytes(data)[: len(data) // 2])
            watched.dead = True
            raise Dead

    return fault
