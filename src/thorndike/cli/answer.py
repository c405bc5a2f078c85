"""What a verb answers, and how it reaches the terminal: words for people, one JSON object for programs."""

import contextlib
import json
import math
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, Union

if TYPE_CHECKING:
    from rich.console import RenderableType


_LONGEST = 1200
"""Characters of an error."""


class Answer(NamedTuple):
    """One result in both forms."""

    data: Mapping[str, object]
    """What ``--json`` prints."""
    text: Union[str, "RenderableType"]
    """What people read; anything rich can draw."""
    exit_status: int = 0


def show(answer: Answer, as_json: bool) -> None:
    """Print an answer on stdout."""
    if as_json:
        print(as_json_text(answer.data))
    elif isinstance(answer.text, str):
        print(answer.text)
    else:
        from rich.console import Console

        # In a pipe a row is a line, however long.
        Console(width=None if sys.stdout.isatty() else 1_000, highlight=False).print(answer.text)


def one_line(message: str) -> str:
    """A message on one line that a terminal can show: no control characters, and the middle of what is very long left out."""
    line = printable(" ".join(message.split()))
    return line if len(line) <= _LONGEST else f"{line[: _LONGEST // 2]} ... {line[-_LONGEST // 4 :]}"


def printable(text: str) -> str:
    """The text with its control characters, and what is no Unicode, written out: an escape sequence would act on the terminal."""
    return text if text.isprintable() else "".join(each if each.isprintable() else each.encode("unicode_escape").decode() for each in text)


def as_json_text(data: Mapping[str, object]) -> str:
    """One line of standard JSON: paths as text, and null for what is no number (JSON has no NaN)."""
    return json.dumps(_plain(data), allow_nan=False)


def _plain(value: object) -> object:
    match value:
        case Mapping():
            return {str(key): _plain(part) for key, part in value.items()}
        case str() | bool() | int() | None:
            return value
        case float():
            return float(value) if math.isfinite(value) else None
        case Path():
            return str(value)
        case Sequence():
            return [_plain(part) for part in value]
    # Arrays and scalars of NumPy and JAX, which are not imported here.
    to_list = getattr(value, "tolist", None)
    return _plain(to_list()) if callable(to_list) else str(value)


@contextlib.contextmanager
def stdout_for_the_answer_only() -> Iterator[None]:
    """Meanwhile whatever is written to stdout, by C++ and subprocesses too, goes to stderr: with ``--json`` one object stands alone."""
    sys.stdout.flush()
    kept = os.dup(1)
    os.dup2(2, 1)
    try:
        with contextlib.redirect_stdout(sys.stderr):
            yield
    finally:
        sys.stderr.flush()
        os.dup2(kept, 1)
        os.close(kept)
