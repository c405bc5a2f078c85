"""The runs under a folder, and what their files say. JSON files only: listing runs must not wait for JAX."""

import os
from pathlib import Path

from thorndike.training.json_files import parse_object, read_object

FACTS = "run.json"


def all_runs(output: Path) -> list[Path]:
    """Every run directory under `output`, oldest first (run directories start with their date and time)."""
    found: list[Path] = []
    for directory, below, files in os.walk(output):
        if FACTS in files:
            found.append(Path(directory))
            below.clear()
    return sorted(found, key=lambda run: (run.name[:15], run.joinpath(FACTS).stat().st_mtime_ns))


def read_facts(run: Path) -> dict[str, object]:
    """What ``run.json`` says. Raises UserError if it is no JSON object."""
    return read_object(run / FACTS)


def last_row(path: Path) -> dict[str, object]:
    """The last complete line of a ``.jsonl`` file as an object; empty if there is none."""
    lines = path.read_bytes().split(b"\n")[:-1] if path.is_file() else []
    return parse_object(lines[-1], path) if lines else {}
