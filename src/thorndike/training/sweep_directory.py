"""The directory of a sweep: ``sweep.json`` (what was asked for, how it stands), ``trials.jsonl`` (a line a trial), ``response.png``."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, cast

from thorndike.errors import UserError
from thorndike.training.json_files import OBJECT, OBJECTS, TEXT, Json, Kind, check_fields, optional, quoted, read_object, whole
from thorndike.training.run_directory import append_lines, new_run_directory, read_lines, truncate_lines
from thorndike.training.sealed_folders import flush
from thorndike.training.sweep_ranges import MOST_TRIALS, SEARCHES, Settings

SWEEP_FORMAT = 1
FACTS, TRIALS, PICTURE = "sweep.json", "trials.jsonl", "response.png"
_MOST = 10**9
_FIELDS = {
    "algorithm": TEXT,
    "environment": TEXT,
    "env_kwargs": OBJECT,
    "max_episode_steps": optional(whole(1)),
    "engine": TEXT,
    "config": OBJECT,
    "wrappers": OBJECTS,
    "preset": TEXT,
    "steps": whole(1),
    "seeds": whole(1, _MOST),
    "seed": whole(0, 2**32 - 1),
    "num_envs": whole(1, _MOST),
    "log_every": whole(1),
    "checkpoint_every": whole(1),
    "device": TEXT,
    "processors": TEXT,
    "fixed": OBJECT,
    "over": OBJECT,
    "search": Kind(f"one of {', '.join(SEARCHES[1:])}", lambda value: value in SEARCHES[1:]),
    "trials": whole(1, MOST_TRIALS),
    "at_once": whole(1, _MOST),
    "episodes": whole(1, _MOST),
    "fresh_seeds": whole(1, _MOST),
    "fresh_seed": whole(0, 2**32 - 1),
    "name": optional(TEXT),
    "status": TEXT,
}


class TrialRow(NamedTuple):
    """A finished trial, a line of ``trials.jsonl``."""

    trial: int
    steps: int
    """Environment steps of each seed."""
    settings: Settings
    scores: tuple[float | None, ...]
    """Of each seed the mean return of its final greedy policy; None where training failed."""
    failures: tuple[str | None, ...]
    curve_steps: tuple[int, ...]
    curve: tuple[tuple[float | None, ...], ...]
    """Mean return of each seed's training episodes since the point before ``[P][S]``."""

    @property
    def mean(self) -> float:
        """The mean over the seeds that did not fail, NaN if all did."""
        known = [score for score in self.scores if score is not None]
        return sum(known) / len(known) if known else math.nan


def new_sweep_directory(output: str | Path, environment: str, algorithm: str, name: str | None) -> Path:
    """Make ``output/environment/sweep-algorithm/date-time-name``: it holds no ``run.json``, so it is no run to anybody."""
    return new_run_directory(output, environment, f"sweep-{algorithm}", name)


def read_sweep(sweep: Path) -> Json:
    """The ``sweep.json`` of a sweep, every field that is needed checked. Raises ``UserError`` in one line."""
    path = sweep / FACTS
    try:
        content = read_object(path)
    except FileNotFoundError:
        raise UserError(f"{sweep} is no sweep: it has no {FACTS}; give a directory such as runs/CartPole-v1/sweep-ppo/...") from None
    if content.get("format") != SWEEP_FORMAT:
        raise UserError(f"{sweep} has format {quoted(content.get('format'))}; this version of thorndike reads format {SWEEP_FORMAT}")
    check_fields(content, _FIELDS, path)
    return content


def find_sweep(text: str, output: Path) -> Path:
    """The sweep meant by a path, ``latest``, or a part of its path under `output` that no other sweep has. Raises ``UserError``."""
    path = Path(text)
    if (path / FACTS).is_file():
        return path
    known = sorted((facts.parent for facts in output.glob(f"*/*/*/{FACTS}")), key=lambda sweep: sweep.name)
    if not known:
        raise UserError(f"there is no sweep '{text}': {output}/ holds none yet")
    matching = known[-1:] if text == "latest" else [sweep for sweep in known if text in str(sweep.relative_to(output))]
    if len(matching) != 1:
        newest = ", ".join(str(sweep.relative_to(output)) for sweep in known[-3:])
        raise UserError(f"'{text}' fits {len(matching)} sweeps under {output}/; the newest there are: {newest}")
    return matching[0]


def add_trials(sweep: Path, rows: Sequence[TrialRow]) -> None:
    """Append trials and flush them to the disk. Raises ``UserError`` where the disk refuses: what is there stays intact."""
    path = sweep / TRIALS
    try:
        append_lines(path, [row._asdict() for row in rows])
        flush(path)
    except OSError as error:
        raise UserError(f"{path} cannot be written: {error.strerror}; make room, then: thorndike sweep --resume {sweep}") from error


def read_trials(sweep: Path, seeds: int) -> dict[int, TrialRow]:
    """The finished trials by number. Half a line, which a killed process leaves behind, is dropped from the file."""
    path = sweep / TRIALS
    truncate_lines(path, 2**53)
    rows = [_row(line, path, seeds) for line in read_lines(path)]
    return {row.trial: row for row in rows}


def _row(line: Mapping[str, object], path: Path, seeds: int) -> TrialRow:
    scores = Kind(f"{seeds} numbers or nulls", lambda value: isinstance(value, list) and len(value) == seeds and all(map(_is_score, value)))
    texts = Kind(f"{seeds} texts or nulls", lambda value: isinstance(value, list) and len(value) == seeds)
    curve = Kind("a list of such lists", lambda value: isinstance(value, list) and all(map(scores.admits, value)))
    numbers = Kind("a list of numbers", lambda value: isinstance(value, list) and all(type(part) is int for part in value))
    kinds = {"trial": whole(0, MOST_TRIALS), "steps": whole(1), "settings": OBJECT, "scores": scores, "failures": texts}
    check_fields(line, {**kinds, "curve_steps": numbers, "curve": curve}, path)
    told = cast(dict, line)
    settings = {name: tuple(value) if isinstance(value, list) else value for name, value in told["settings"].items()}
    parts = tuple(told["scores"]), tuple(told["failures"]), tuple(told["curve_steps"]), tuple(map(tuple, told["curve"]))
    return TrialRow(told["trial"], told["steps"], settings, *parts)


def _is_score(value: object) -> bool:
    return value is None or (type(value) in (int, float) and math.isfinite(cast(float, value)))
