"""Text and preferences in files: TRL's formats, standard and conversational, as JSON lines, JSON or CSV.

A file is read whole or refused, with one line that names the row. Columns that a format does not know are kept.
"""

import csv
import io
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from thorndike.errors import UserError
from thorndike.language.data import Row, parsed_json, read_rows
from thorndike.training.json_files import Json, quoted

FORMATS: dict[str, tuple[str, ...]] = {
    "preference": ("chosen", "rejected"),
    "candidates": ("prompt", "candidates"),
    "completions": ("prompt", "completions"),
    "unpaired_preference": ("prompt", "completion", "label"),
    "prompt_completion": ("prompt", "completion"),
    "language_modeling": ("text",),
    "prompt_only": ("prompt",),
}
"""The columns that make each format, the most telling ones first; of several candidates in ours (``generate`` writes ``completions``)."""
ENDINGS = (".jsonl", ".json", ".csv")

_ANSWERS = ("chosen", "rejected", "completion", "text", "messages")
_DEEPEST = 60


class Records(NamedTuple):
    """What a file holds."""

    format: str
    conversational: bool
    """Whether texts are lists of messages."""
    rows: list[Json]
    places: list[str]
    """Of each row: the file and its number, as messages have them."""
    where: str
    """The file."""


def read_records(path: str | Path) -> Records:
    """The rows of a file, its format told by its columns. Raises ``UserError``, one line that names file and row."""
    path = Path(path)
    rows = read_rows(path)
    if path.suffix == ".csv":
        rows = [Row({name: _cell(name, cell, row.where) for name, cell in row.content.items()}, row.where) for row in rows]
    return _checked(rows, str(path))


def check_records(rows: Sequence[Mapping[str, object]], where: str) -> Records:
    """Rows that are in memory, checked like those of a file: all of one format, nothing empty."""
    return _checked([Row(dict(row), f"{where}, row {number}") for number, row in enumerate(rows, start=1)], where)


def _checked(rows: Sequence[Row], where: str) -> Records:
    known: tuple[str, bool] | None = None
    for row, place in rows:
        _check_text(row, place, _DEEPEST)
        kind = _format_of(row, place)
        found = kind, _check_row(kind, row, place)
        if known is not None and found != known:
            raise UserError(f"{place} is {_words(found)}, but the rows before are {_words(known)}: keep them in files of their own")
        known = found
    if known is None:
        raise UserError(f"{where} holds no rows")
    return Records(*known, [dict(row.content) for row in rows], [row.where for row in rows], where)


def write_records(path: str | Path, rows: Iterable[Mapping[str, object]]) -> int:
    """Write rows to a file, its form told by its ending; how many they were. The file is there as a whole, or as it was before.

    In CSV what is no text is written as JSON, and ``read_records`` reads it back. Raises ``UserError`` for a text that no file can hold,
    and where nothing can be written.
    """
    path = Path(path)
    written = [dict(row) for row in rows]
    for number, row in enumerate(written, start=1):
        _check_text(row, f"{path}, row {number}", _DEEPEST)
    text = as_text(written, path.suffix.lower(), path)
    aside = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with aside.open("w", encoding="utf-8", newline="") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        aside.replace(path)
    except OSError as error:
        aside.unlink(missing_ok=True)
        raise UserError(f"{path} cannot be written: {error.strerror}") from error
    return len(written)


def as_text(rows: Sequence[Json], ending: str, where: str | Path) -> str:
    """Rows in the form that an ending of ``ENDINGS`` tells."""
    match ending:
        case ".jsonl":
            return "".join(json.dumps(row, ensure_ascii=False, allow_nan=False) + "\n" for row in rows)
        case ".json":
            return json.dumps(rows, ensure_ascii=False, allow_nan=False, indent=1) + "\n"
        case ".csv":
            return _as_csv(rows)
    raise UserError(f"{where}: expected a file that ends in {', '.join(ENDINGS)}")


def with_explicit_prompt(row: Mapping[str, object]) -> Json:
    """A preference whose prompt stands at the beginning of both answers, with the prompt on its own; another row as it is.

    What both begin with: messages that are equal, or characters, without the space at the end, as TRL's ``extract_prompt`` has it; but
    where nothing is in common all stays an answer: TRL's cuts off the rest of one that ends in a space.
    """
    if "prompt" in row or not {"chosen", "rejected"} <= row.keys():
        return dict(row)
    chosen, rejected = row["chosen"], row["rejected"]
    assert isinstance(chosen, str | list) and isinstance(rejected, str | list)
    shorter = min(len(chosen), len(rejected))
    common = next((place for place in range(shorter) if chosen[place] != rejected[place]), None)
    if common is None:
        # One begins with all of the other: its last part stays an answer, so that none is empty.
        common = shorter - 1
    elif common > 0 and chosen[common - 1] == " ":
        common -= 1
    return {"prompt": chosen[:common], **row, "chosen": chosen[common:], "rejected": rejected[common:]}


def _words(kind: tuple[str, bool]) -> str:
    return f"{'conversational' if kind[1] else 'standard'} {kind[0].replace('_', ' ')}"


def _format_of(row: Mapping[str, object], place: str) -> str:
    if "messages" in row:
        return "language_modeling"
    for name, columns in FORMATS.items():
        if all(row.get(column) is not None for column in columns):
            if name == "prompt_only":
                _refuse_half_a_preference(row, place)
            return name
    known = "; ".join(", ".join(columns) for columns in FORMATS.values())
    raise UserError(f"{place} has the columns {', '.join(map(quoted, row)) or '(none)'}, but some of these are expected: {known}")


def _refuse_half_a_preference(row: Mapping[str, object], place: str) -> None:
    """Raises for a row that would pass for a prompt alone, and whose one answer would be lost."""
    there = [column for column in FORMATS["preference"] if row.get(column) is not None]
    if len(there) == 1:
        (missing,) = set(FORMATS["preference"]) - set(there)
        raise UserError(f"{place} has '{there[0]}' but no '{missing}'")


def _check_row(kind: str, row: Mapping[str, object], place: str) -> bool:
    """Whether the row is conversational; raises where it is neither."""
    if kind in ("candidates", "completions"):
        return _check_candidates(row, kind, place)
    columns = ("messages",) if "messages" in row else FORMATS[kind]
    texts = [column for column in (*columns, *(("prompt",) if "prompt" in row else ())) if column != "label"]
    kinds = {column: _is_messages(row[column], f"{place}: '{column}'", column in _ANSWERS or kind == "prompt_only") for column in texts}
    if len(set(kinds.values())) > 1:
        told = ", ".join(f"'{column}' is {'messages' if each else 'text'}" for column, each in kinds.items())
        raise UserError(f"{place} mixes forms: {told}")
    if kind == "unpaired_preference" and not isinstance(row["label"], bool):
        raise UserError(f"{place}: 'label' is {quoted(row['label'])}, but it must be true or false")
    if kind == "preference" and row["chosen"] == row["rejected"]:
        raise UserError(f"{place}: 'chosen' and 'rejected' are the same")
    return next(iter(kinds.values()))


def _check_candidates(row: Mapping[str, object], kind: str, place: str) -> bool:
    given = row[kind]
    if not isinstance(given, list) or len(given) < 2:
        raise UserError(f"{place}: '{kind}' is {quoted(given)}, but it must be a list of at least 2")
    kinds = [_is_content(each, f"{place}: candidate {number}") for number, each in enumerate(given, start=1)]
    prompt = _is_content(row["prompt"], f"{place}: 'prompt'")
    return prompt or any(kinds)


def _is_content(value: object, place: str) -> bool:
    if not isinstance(value, dict):
        return _is_messages(value, place, True)
    if not any(isinstance(value.get(name), str) for name in ("text", "media")) and "messages" not in value:
        raise UserError(f"{place} is {quoted(value)}, but it must be text, messages, or an object with 'text', 'messages' or 'media'")
    if "messages" in value:
        return _is_messages(value["messages"], place, True)
    return False


def _is_messages(value: object, place: str, must_not_be_empty: bool) -> bool:
    if isinstance(value, str):
        if must_not_be_empty and not value.strip():
            raise UserError(f"{place} is empty")
        return False
    if not isinstance(value, list):
        raise UserError(f"{place} is {quoted(value)}, but it must be text, or a list of messages")
    if not value and must_not_be_empty:
        raise UserError(f"{place} is empty")
    for number, message in enumerate(value, start=1):
        is_one = isinstance(message, dict) and all(isinstance(message.get(name), str) for name in ("role", "content"))
        if not is_one or not message["role"]:
            raise UserError(f"{place}, message {number} is {quoted(message)}, but it must be an object with the texts 'role' and 'content'")
    return True


def _cell(column: str, text: object, place: str) -> object:
    assert isinstance(text, str)
    if column == "label":
        return {"true": True, "false": False, "1": True, "0": False}.get(text.strip().lower(), text)
    if text.startswith(("[{", '["', '{"')):
        return parsed_json(text.encode(), f"{place}: '{column}'")
    return text


def _as_csv(rows: Sequence[Json]) -> str:
    heading = list(dict.fromkeys(name for row in rows for name in row))
    out = io.StringIO(newline="")
    writer = csv.writer(out)
    writer.writerow(heading)
    for row in rows:
        cells = [row.get(name, "") for name in heading]
        writer.writerow([cell if isinstance(cell, str) else json.dumps(cell, ensure_ascii=False, allow_nan=False) for cell in cells])
    return out.getvalue()


def _check_text(value: object, place: str, depth: int) -> None:
    """Raises for what no file or database can hold: halves of characters, which escapes can write, and endless nesting."""
    if depth == 0:
        raise UserError(f"{place} is nested too deeply")
    if isinstance(value, str):
        if any("\ud800" <= each <= "\udfff" for each in value):
            raise UserError(f"{place} holds half a character (a lone surrogate): mend its encoding")
    elif isinstance(value, list):
        for part in value:
            _check_text(part, place, depth - 1)
    elif isinstance(value, dict):
        for name, part in value.items():
            _check_text(name, place, 1)
            _check_text(part, place, depth - 1)
