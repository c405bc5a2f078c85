"""Runs one contestant: one pinned process, equal conditions, its resources read by the kernel's own accounting."""

import json
import os
import signal
import subprocess
import tempfile
import threading
import time
from pathlib import Path
from typing import NamedTuple

EQUAL_CONDITIONS = {
    "NPROC": "1",
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "JAX_PLATFORMS": "cpu",
    "CUDA_VISIBLE_DEVICES": "",
    "PYTHONHASHSEED": "0",
}
"""Over the caller's environment. One thread everywhere: with two, JAX's pool wastes CPU-seconds on programs as small as these, which would
flatter whoever sets one. ``NPROC`` is the number of processors that jaxlib sees; the process is pinned to one core besides.
"""
FORGOTTEN = ("JAX_COMPILATION_CACHE_DIR", "JAX_ENABLE_X64", "THORNDIKE_CACHE", "XDG_CACHE_HOME", "XLA_FLAGS")
"""Variables of the caller that would make the conditions unequal."""


class Finished(NamedTuple):
    """How a process ended."""

    spawned_at: float
    """``time.monotonic()`` at its start."""
    wall_s: float
    cpu_s: float
    """User + system, its finished children included (``wait4``)."""
    peak_memory_mb: float
    exit_code: int
    stdout: str
    stderr: str


def run_pinned(command: list[str], environment: dict[str, str], core: int | None, timeout_s: float) -> Finished:
    """Run ``command`` on ``core`` (``None``: wherever) and wait.

    After ``timeout_s`` it is killed with its children; its exit code is then -9.
    """
    words = command if core is None else ["taskset", "-c", str(core), *command]
    inherited = {name: value for name, value in os.environ.items() if name not in FORGOTTEN}
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        spawned_at = time.monotonic()
        process = subprocess.Popen(
            words,
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=err,
            env={**inherited, **EQUAL_CONDITIONS, **environment},
            start_new_session=True,
        )
        timer = threading.Timer(timeout_s, os.killpg, (process.pid, signal.SIGKILL))
        timer.start()
        try:
            _, status, usage = os.wait4(process.pid, 0)
        except BaseException:
            os.killpg(process.pid, signal.SIGKILL)
            raise
        finally:
            timer.cancel()
        wall_s = time.monotonic() - spawned_at
        process.returncode = os.waitstatus_to_exitcode(status)
        out.seek(0)
        err.seek(0)
        stdout, stderr = out.read().decode(errors="replace"), err.read().decode(errors="replace")
    cpu_s = usage.ru_utime + usage.ru_stime
    return Finished(spawned_at, wall_s, cpu_s, usage.ru_maxrss / 1024, process.returncode, stdout, stderr)


def last_json(text: str) -> dict | None:
    """The last line of ``text`` that is a JSON object, if any."""
    for line in reversed(text.splitlines()):
        if line.startswith("{"):
            value = json.loads(line)
            return value if isinstance(value, dict) else None
    return None


def cores() -> list[int]:
    """The cores this process may use, in order."""
    return sorted(os.sched_getaffinity(0))


def fill(words: tuple[str, ...], names: dict[str, str]) -> list[str]:
    """``words`` with ``{name}`` replaced; other braces are left alone."""
    return [replace(word, names) for word in words]


def replace(word: str, names: dict[str, str]) -> str:
    """``word`` with each ``{name}`` replaced."""
    for name, value in names.items():
        word = word.replace("{" + name + "}", value)
    return word


def make_folder(path: Path) -> str:
    """The folder, made if it is not there, as text."""
    path.mkdir(parents=True, exist_ok=True)
    return str(path)
