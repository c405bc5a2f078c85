"""JSON files of a run, read with suspicion: whatever such a file holds, the answer is an object or one line that says what is wrong."""

import json
import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple, TypeAlias

from thorndike.errors import UserError

Json: TypeAlias = dict[str, object]

_LARGEST = 64 * 2**20
"""Bytes: the longest thing written is a list of the blocks of a replay buffer, and far shorter."""
_DEEPEST = 40
_SHOWN = 60
"""Characters of a wrong value that are quoted."""


class Kind(NamedTuple):
    """What a value must be, in words and as a test."""

    words: str
    admits: Callable[[object], bool]


def whole(lowest: int, highest: int = 2**53) -> Kind:
    """A whole number between two bounds, both allowed."""
    return Kind(f"a whole number from {lowest} to {highest}", lambda value: type(value) is int and lowest <= value <= highest)


def optional(kind: Kind) -> Kind:
    """The same, or null."""
    return Kind(f"{kind.words}, or null", lambda value: value is None or kind.admits(value))


TEXT = Kind("a short text", lambda value: isinstance(value, str) and value.isprintable() and len(value) < 4096)
FLAG = Kind("true or false", lambda value: isinstance(value, bool))
SECONDS = Kind(
    "a number of at least 0",
    lambda value: isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value) and value >= 0,
)
NUMBER = Kind("a number", lambda value: type(value) in (int, float))
OBJECT = Kind("an object", lambda value: isinstance(value, dict))
OBJECTS = Kind("a list of objects", lambda value: isinstance(value, list) and all(isinstance(part, dict) for part in value))


def parse_object(data: bytes, where: str | Path) -> Json:
    """The object that a JSON text holds. Raises ``UserError`` for anything else, and for what no run's file is: huge or deeply nested."""
    if len(data) > _LARGEST:
        raise UserError(f"{where} is damaged: it is longer than any such file")
    try:
        content = json.loads(data)
    except RecursionError:
        raise UserError(f"{where} is damaged: it is nested too deeply") from None
    except ValueError as error:
        raise UserError(f"{where} is damaged: {str(error)[:200]}") from None
    if not isinstance(content, dict):
        raise UserError(f"{where} is damaged: expected an object, got {quoted(content)}")
    if _nested(content, _DEEPEST):
        raise UserError(f"{where} is damaged: it is nested too deeply")
    return content


def read_object(path: Path) -> Json:
    """The object in a JSON file. Raises ``UserError`` for one that is damaged, ``FileNotFoundError`` where there is none."""
    try:
        with path.open("rb") as file:
            return parse_object(file.read(_LARGEST + 1), path)
    except FileNotFoundError:
        raise
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}") from error


def check_fields(content: Mapping[str, object], kinds: Mapping[str, Kind], where: str | Path) -> None:
    """Raises ``UserError`` for the first field that is missing or not of its kind."""
    for name, kind in kinds.items():
        if name not in content:
            raise UserError(f"{where} is damaged: it has no '{name}'")
        if not kind.admits(content[name]):
            raise UserError(f"{where} is damaged: '{name}' is {quoted(content[name])}, but it must be {kind.words}")


@contextmanager
def blamed_on(where: str | Path) -> Iterator[None]:
    """What cannot be made of a file's content is that file's fault: a ``UserError`` in place of whatever its values led to."""
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        raise UserError(f"{where} is damaged: nothing can be made of it: {type(error).__name__}: {str(error)[:200]}") from error


def as_bytes(content: Mapping[str, object]) -> bytes:
    """The one way in which an object is written."""
    return (json.dumps(content, indent=2) + "\n").encode()


def quoted(value: object) -> str:
    """A wrong value as it is shown in a message: on one line, and short."""
    text = repr(value)
    return text if len(text) <= _SHOWN else text[:_SHOWN] + "..."


def _nested(value: object, depth: int) -> bool:
    """Whether containers lie deeper in each other than `depth`."""
    parts = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return depth == 0 or any(_nested(part, depth - 1) for part in parts if isinstance(part, dict | list))
