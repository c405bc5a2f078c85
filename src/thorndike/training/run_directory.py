"""The directory of a run: what is written where, and nothing else. No other run is ever overwritten."""

import json
import os
import platform
import re
import subprocess
import time
from collections.abc import Iterable, Mapping
from datetime import datetime
from importlib import metadata
from pathlib import Path
from typing import cast

from thorndike.errors import UserError
from thorndike.training.json_files import Json, as_bytes, parse_object, quoted, read_object
from thorndike.training.machine import machine
from thorndike.training.sealed_folders import flush, write_all, write_durably

FORMAT = 1
_PACKAGES = ("thorndike", "jax", "jaxlib", "flax", "optax", "numpy", "gymnasium", "envpool", "ale-py", "mujoco")


def new_run_directory(output: str | Path, environment: str, algorithm: str, name: str | None) -> Path:
    """Make ``output/environment/algorithm/date-time-name``; a number is added if it exists already."""
    stamp = datetime.now().strftime("%Y%m%d-%H%M%S")
    readable = re.sub(r"[^A-Za-z0-9_.-]+", "-", environment).strip("-.") or "environment"
    label = re.sub(r"[^A-Za-z0-9_.-]+", "-", name or "run").strip("-.") or "run"
    parent = Path(output) / readable / algorithm
    for attempt in range(1, 10_000):
        path = parent / (f"{stamp}-{label}" if attempt == 1 else f"{stamp}-{label}-{attempt}")
        try:
            path.mkdir(parents=True)
        except FileExistsError:
            continue
        except OSError as error:
            raise UserError(f"cannot make the run's directory {path}: {error.strerror}; choose another with --output") from error
        return path
    raise UserError(f"10,000 runs called {stamp}-{label} exist in {parent}; give another --name")


def write_json(path: Path, content: Mapping[str, object]) -> None:
    """Write a JSON file aside, flush it to the disk and rename it, so that a reader never sees half of it."""
    _replace(path, as_bytes(content))


def read_run(run: str | Path) -> dict:
    """The ``run.json`` of a run. Raises ``UserError`` if there is none, or one this version cannot read."""
    path = Path(run) / "run.json"
    try:
        content = read_object(path)
    except FileNotFoundError:
        raise UserError(f"{run} is no run: it has no run.json; `thorndike list` shows the runs there are") from None
    if content.get("format") != FORMAT:
        raise UserError(f"{run} has format {quoted(content.get('format'))}; this version of thorndike reads format {FORMAT}")
    return content


def refuse_if_gone(run: Path) -> None:
    """Raises ``UserError`` if the run's directory is not there any more."""
    if not run.is_dir():
        raise UserError(f"{run} is gone, with all that was kept in it: training stopped; train again, and leave the directory where it is")


def append_lines(path: Path, rows: Iterable[Mapping[str, object]]) -> None:
    """Append JSON lines, all or none: where they do not fit on the disk, the file is as it was before."""
    data = b"".join(json.dumps(row).encode() + b"\n" for row in rows)
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
    try:
        size = os.fstat(descriptor).st_size
        try:
            write_all(descriptor, data)
        except OSError:
            os.ftruncate(descriptor, size)
            raise
    finally:
        os.close(descriptor)


def read_lines(path: Path) -> list[Json]:
    """The objects of a ``.jsonl`` file that have a number of ``steps``; half a line, which a killed process leaves behind, is none."""
    lines = path.read_bytes().split(b"\n") if path.exists() else []
    return [row for row in map(_row, lines) if row is not None]


def truncate_lines(path: Path, last_step: int) -> None:
    """Drop the JSON lines of later steps than ``last_step``: what an interrupted run logged after its last checkpoint."""
    if not path.exists():
        return
    content = path.read_bytes()
    rows = [(line, _row(line)) for line in content.split(b"\n")]
    kept = b"".join(line + b"\n" for line, row in rows if row is not None and cast(float, row["steps"]) <= last_step)
    if kept != content:
        _replace(path, kept)


def checkpoints(run: Path) -> list[Path]:
    """The checkpoints of a run, oldest first."""
    found = [path for path in (run / "checkpoints").glob("*") if path.name.isdecimal() and path.name.isascii()]
    return sorted(found, key=lambda path: int(path.name))


def checkpoint_of(run: Path, step: str | int) -> Path:
    """The checkpoint of a run at a step. Raises ``UserError``, with the steps there are, if there is none."""
    known = {path.name: path for path in checkpoints(run)}
    if str(step) not in known:
        there = f"it has those of {', '.join(known)}" if known else "it has none"
        raise UserError(f"{run} has no checkpoint of step {step}: {there if run.is_dir() else 'there is no such folder'}")
    return known[str(step)]


def facts() -> dict[str, object]:
    """Versions, machine and commit: what one needs to know to make the run again."""
    versions = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return {
        "format": FORMAT,
        "created": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        "versions": versions,
        "platform": platform.platform(),
        "processors": os.environ.get("NPROC") or str(os.cpu_count()),
        "machine": machine(),
        "git_commit": _git_commit(),
    }


def _git_commit() -> str | None:
    """Commit of the working directory, if it is a git checkout."""
    try:
        answer = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, timeout=5, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return answer.stdout.strip() or None


def _row(line: bytes) -> Json | None:
    try:
        row = parse_object(line, "line")
    except UserError:
        return None
    return row if type(row.get("steps")) in (int, float) else None


def _replace(path: Path, data: bytes) -> None:
    aside = path.with_name(path.name + ".partial")
    aside.unlink(missing_ok=True)
    write_durably(aside, data)
    os.replace(aside, path)
    flush(path.parent)
