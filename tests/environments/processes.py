"""Which processes there are, read from /proc."""

import os
import time
from collections.abc import Iterable
from pathlib import Path


def workers_of(parent: int | None = None) -> list[int]:
    """The worker processes that this process, or another one, has started."""
    parent = os.getpid() if parent is None else parent
    return [int(pid) for pid, (_, above, _) in _table().items() if above == parent and b"host.worker" in _words(pid)]


def left_of(groups: Iterable[int], patience: float = 1.0) -> list[int]:
    """Who still runs in these process groups: the workers that led them, and what they started. The kernel is given a moment."""
    groups, deadline = set(groups), time.monotonic() + patience
    while (left := _running(groups)) and time.monotonic() < deadline:
        time.sleep(0.01)
    return left


def _running(groups: set[int]) -> list[int]:
    return [int(pid) for pid, (state, _, group) in _table().items() if group in groups and state not in "ZX"]


def _table() -> dict[str, tuple[str, int, int]]:
    """State, parent and process group of each process."""
    rows = {}
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            words = _read(folder / "stat").rpartition(b")")[2].split()
            if words:
                rows[folder.name] = (words[0].decode(), int(words[1]), int(words[2]))
    return rows


def _words(pid: str) -> bytes:
    return _read(Path("/proc") / pid / "cmdline")


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except (FileNotFoundError, ProcessLookupError):
        # It ended while the table was read.
        return b""
