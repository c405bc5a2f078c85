"""From what a user calls a run to its directory."""

import os
from argparse import ArgumentParser
from pathlib import Path

from thorndike.errors import UserError
from thorndike.suggestions import nearest
from thorndike.training.run_listing import FACTS, all_runs


def add_run_arguments(parser: ArgumentParser, several: bool = False) -> None:
    """The argument RUN (or RUN...), and where runs are looked for."""
    help_text = "a run's directory, a part of its name that only it has, or `latest`"
    if several:
        parser.add_argument("runs", metavar="RUN", nargs="+", help=help_text)
    else:
        parser.add_argument("run", metavar="RUN", help=help_text)
    add_output_argument(parser)


def add_output_argument(parser: ArgumentParser) -> None:
    """``--output DIR``, where runs live."""
    parser.add_argument("--output", metavar="DIR", type=Path, default=Path("runs"), help="the folder that runs are in (default: runs)")


def find_run(text: str, output: Path) -> Path:
    """The run meant by a path, ``latest``, or a part of its path under `output` that no other run has.

    Raises UserError if there is none, or more than one.
    """
    path = Path(text)
    if exists(path):
        for candidate in (path, *path.parents):
            if candidate.joinpath(FACTS).is_file():
                return candidate
    known = all_runs(output)
    if not known:
        raise UserError(f"there is no run '{text}': {output}/ holds no run yet; make one: thorndike train ppo CartPole-v1")
    if text == "latest":
        return known[-1]
    matching = [run for run in known if text in str(run.relative_to(output))]
    if len(matching) == 1:
        return matching[0]
    if matching:
        newest = ", ".join(str(run.relative_to(output)) for run in matching[-3:])
        raise UserError(f"'{text}' fits {len(matching)} runs under {output}/; say more of the name, or latest; the newest: {newest}")
    close = nearest(text, ["latest", *(run.name for run in known)])
    hint = f"; did you mean '{close}'?" if close else "; `thorndike list` shows the runs"
    raise UserError(f"there is no run '{text}' under {output}/{hint}")


def exists(path: Path) -> bool:
    """Whether there is anything; a name that no file could have is none."""
    return os.path.exists(path)


def is_file(path: Path) -> bool:
    """Whether there is a file; a name that no file could have is none."""
    return os.path.isfile(path)
