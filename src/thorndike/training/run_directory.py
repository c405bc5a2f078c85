"""The directory of a run: what is written where, and nothing else. No other run is ever overwritten."""

import hashlib
import json
import os
import platform
import re
import shutil
import subprocess
import time
from collections.abc import Iterable, Mapping
from datetime import datetime
from importlib import metadata
from pathlib import Path

from thorndike.errors import UserError

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
    aside = path.with_name(path.name + ".partial")
    with aside.open("w", encoding="utf-8") as file:
        json.dump(content, file, indent=2)
        file.write("\n")
        file.flush()
        os.fsync(file.fileno())
    aside.replace(path)


def read_run(run: str | Path) -> dict:
    """The ``run.json`` of a run. Raises ``UserError`` if there is none, or one this version cannot read."""
    path = Path(run) / "run.json"
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise UserError(f"{run} is no run: it has no run.json; `thorndike list` shows the runs there are") from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise UserError(f"{path} is damaged: {error}") from None
    if content.get("format") != FORMAT:
        raise UserError(f"{run} has format {content.get('format')!r}; this version of thorndike reads format {FORMAT}")
    return content


def append_lines(path: Path, rows: Iterable[Mapping[str, object]]) -> None:
    """Append JSON lines."""
    with path.open("a", encoding="utf-8") as file:
        file.writelines(json.dumps(row) + "\n" for row in rows)


def truncate_lines(path: Path, last_step: int) -> None:
    """Drop the JSON lines of later steps than ``last_step``: what an interrupted run logged after its last checkpoint."""
    if not path.exists():
        return
    kept = [line for line in path.read_text(encoding="utf-8").splitlines() if _step_of(line) <= last_step]
    aside = path.with_name(path.name + ".partial")
    aside.write_text("".join(line + "\n" for line in kept), encoding="utf-8")
    aside.replace(path)


def _step_of(line: str) -> float:
    try:
        return json.loads(line)["steps"]
    except (json.JSONDecodeError, KeyError):
        # Half a line is what a killed process leaves behind.
        return float("inf")


def seal(folder: Path) -> None:
    """Write ``manifest.json``: the sha256 of every other file in a folder."""
    files = sorted(path for path in folder.iterdir() if path.name != "manifest.json")
    write_json(folder / "manifest.json", {"sha256": {path.name: _sha256(path) for path in files}})


def intact(folder: Path) -> bool:
    """Whether a folder has a manifest and every file in it is as it was written."""
    try:
        hashes = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))["sha256"]
        return all(_sha256(folder / name) == digest for name, digest in hashes.items())
    except (OSError, ValueError, KeyError):
        return False


def checkpoints(run: Path) -> list[Path]:
    """The checkpoints of a run, oldest first."""
    found = [path for path in (run / "checkpoints").glob("*") if path.name.isdigit()]
    return sorted(found, key=lambda path: int(path.name))


def publish(aside: Path, final: Path) -> None:
    """Seal a folder written aside, flush its files and rename it into place."""
    seal(aside)
    for path in aside.iterdir():
        with path.open("rb") as file:
            os.fsync(file.fileno())
    old = final.with_name(final.name + ".old")
    if old.exists():
        shutil.rmtree(old)
    if final.exists():
        final.rename(old)
    aside.rename(final)
    flush_folder(final.parent)
    if old.exists():
        shutil.rmtree(old)


def flush_folder(folder: Path) -> None:
    """Make renames in a folder durable."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def facts() -> dict[str, object]:
    """Versions, platform and commit: what one needs to know to make the run again."""
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
        "git_commit": _git_commit(),
    }


def _git_commit() -> str | None:
    """Commit of the working directory, if it is a git checkout."""
    try:
        answer = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, timeout=5, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return answer.stdout.strip() or None


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
