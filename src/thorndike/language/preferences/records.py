"""Text and preferences in files: TRL's formats, standard and conversational, as JSON lines, JSON or CSV.

A file is read whole or refused, with one line that names the row. Columns that a format does not know are kept.
"""

import csv
import io
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, NoReturn, TypeAlias

from thorndike.errors import UserError
from thorndike.training.json_files import quoted

Row: TypeAlias = dict[str, object]

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
_LARGEST_CELL = 2**31 - 1


class Records(NamedTuple):
    """What a file holds."""

    format: str
    conversational: bool
    """Whether texts are lists of messages."""
    rows: list[Row]
    numbers: list[int]
    """Where each row stands in the file: its line of JSON lines, else its place from 1, the heading of a CSV not counted."""


def read_records(path: str | Path) -> Records:
    """The rows of a file, its format told by its columns. Raises ``UserError``, one line that names file and row."""
    path = Path(path)
    if path.suffix.lower() not in ENDINGS:
        raise UserError(f"{path}: expected a file that ends in {', '.join(ENDINGS)}")
    try:
        content = path.read_bytes()
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}") from error
    reader = {".jsonl": _json_lines, ".json": _json_list, ".csv": _csv_rows}[path.suffix.lower()]
    numbered = reader(content, path)
    if not numbered:
        raise UserError(f"{path} holds no rows")
    return check_records([row for _, row in numbered], path, [number for number, _ in numbered])


def check_records(rows: Sequence[Mapping[str, object]], where: str | Path, numbers: Sequence[int] | None = None) -> Records:
    """Rows that are in memory, checked like those of a file: all of one format, nothing empty."""
    numbers = list(range(1, len(rows) + 1)) if numbers is None else list(numbers)
    checked: list[Row] = []
    known: tuple[str, bool] | None = None
    for number, row in zip(numbers, rows, strict=True):
        place = f"{where}, row {number}"
        kind = _format_of(row, place)
        found = kind, _check_row(kind, row, place)
        if known is not None and found != known:
            raise UserError(f"{place} is {_words(found)}, but the rows before are {_words(known)}: keep them in files of their own")
        known = found
        checked.append(dict(row))
    if known is None:
        raise UserError(f"{where} holds no rows")
    return Records(*known, checked, numbers)


def write_records(path: str | Path, rows: Iterable[Mapping[str, object]]) -> int:
    """Write rows to a file, its form told by its ending; how many they were. The file is there as a whole, or as it was before.

    In CSV what is no text is written as JSON, and ``read_records`` reads it back.
    """
    path = Path(path)
    written = [dict(row) for row in rows]
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


def as_text(rows: Sequence[Row], ending: str, where: str | Path) -> str:
    """Rows in the form that an ending of ``ENDINGS`` tells."""
    match ending:
        case ".jsonl":
            return "".join(json.dumps(row, ensure_ascii=False, allow_nan=False) + "\n" for row in rows)
        case ".json":
            return json.dumps(rows, ensure_ascii=False, allow_nan=False, indent=1) + "\n"
        case ".csv":
            return _as_csv(rows)
    raise UserError(f"{where}: expected a file that ends in {', '.join(ENDINGS)}")


def with_explicit_prompt(row: Mapping[str, object]) -> Row:
    """A preference whose prompt stands at the beginning of both answers, with the prompt on its own; another row as it is.

    What both begin with: messages that are equal, or characters, without the space at the end, as TRL's ``extract_prompt`` has it.
    """
    if "prompt" in row or not {"chosen", "rejected"} <= row.keys():
        return dict(row)
    chosen, rejected = row["chosen"], row["rejected"]
    assert isinstance(chosen, str | list) and isinstance(rejected, str | list)
    shorter = min(len(chosen), len(rejected))
    # Where one begins with all of the other, the last part stays an answer: no answer is empty.
    common = next((place for place in range(shorter) if chosen[place] != rejected[place]), shorter - 1)
    if common > 0 and chosen[common - 1] == " ":
        common -= 1
    return {"prompt": chosen[:common], **row, "chosen": chosen[common:], "rejected": rejected[common:]}


def _words(kind: tuple[str, bool]) -> str:
    return f"{'conversational' if kind[1] else 'standard'} {kind[0].replace('_', ' ')}"


def _format_of(row: Mapping[str, object], place: str) -> str:
    if "messages" in row:
        return "language_modeling"
    for name, columns in FORMATS.items():
        if all(row.get(column) is not None for column in columns):
            return name
    known = "; ".join(", ".join(columns) for columns in FORMATS.values())
    raise UserError(f"{place} has the columns {', '.join(map(quoted, row)) or '(none)'}, but some of these are expected: {known}")


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


def _json_lines(content: bytes, path: Path) -> list[tuple[int, Row]]:
    rows = []
    for number, line in enumerate(content.removeprefix(b"\xef\xbb\xbf").split(b"\n"), start=1):
        if line.strip():
            rows.append((number, _as_row(_parse(line, f"{path}, row {number}"), f"{path}, row {number}")))
    return rows


def _json_list(content: bytes, path: Path) -> list[tuple[int, Row]]:
    parsed = _parse(content.removeprefix(b"\xef\xbb\xbf"), str(path))
    if not isinstance(parsed, list):
        raise UserError(f"{path} holds {quoted(parsed)}, but it must hold a list of objects; one object a line goes into a .jsonl file")
    return [(number, _as_row(each, f"{path}, row {number}")) for number, each in enumerate(parsed, start=1)]


def _csv_rows(content: bytes, path: Path) -> list[tuple[int, Row]]:
    lines = content.removeprefix(b"\xef\xbb\xbf")
    try:
        text = lines.decode()
    except UnicodeDecodeError as error:
        line = lines.count(b"\n", 0, error.start) + 1
        raise UserError(f"{path}, line {line} is not UTF-8 text") from error
    csv.field_size_limit(_LARGEST_CELL)
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    rows: list[tuple[int, Row]] = []
    heading: list[str] | None = None
    try:
        for cells in reader:
            if heading is None:
                heading = cells
                if len(set(heading)) < len(heading):
                    raise UserError(f"{path}: its heading names a column twice: {', '.join(map(quoted, heading))}")
            elif cells:
                place = f"{path}, row {len(rows) + 1}"
                if len(cells) != len(heading):
                    raise UserError(f"{place} has {len(cells)} cells, but the heading has {len(heading)}")
                rows.append((len(rows) + 1, {name: _cell(name, cell, place) for name, cell in zip(heading, cells, strict=True)}))
    except csv.Error as error:
        raise UserError(f"{path}, row {len(rows) + 1} is damaged: {error}") from error
    return rows


def _cell(column: str, text: str, place: str) -> object:
    if column == "label":
        return {"true": True, "false": False, "1": True, "0": False}.get(text.strip().lower(), text)
    if text.startswith(("[{", '["', '{"')):
        return _parse(text.encode(), f"{place}: '{column}'")
    return text


def _as_csv(rows: Sequence[Row]) -> str:
    heading = list(dict.fromkeys(name for row in rows for name in row))
    out = io.StringIO(newline="")
    writer = csv.writer(out)
    writer.writerow(heading)
    for row in rows:
        cells = [row.get(name, "") for name in heading]
        writer.writerow([cell if isinstance(cell, str) else json.dumps(cell, ensure_ascii=False, allow_nan=False) for cell in cells])
    return out.getvalue()


def _parse(data: bytes, place: str) -> object:
    try:
        text = data.decode()
    except UnicodeDecodeError as error:
        raise UserError(f"{place} is not UTF-8 text, at byte {error.start + 1}") from error
    try:
        parsed = json.loads(text, object_pairs_hook=_no_name_twice, parse_constant=_no_number)
        _check_text(parsed, _DEEPEST)
    except RecursionError:
        raise UserError(f"{place} is nested too deeply") from None
    except ValueError as error:
        raise UserError(f"{place} is damaged: {str(error)[:200]}") from None
    return parsed


def _no_name_twice(pairs: list[tuple[str, object]]) -> Row:
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError("a name is there twice, of which one value would be lost")
    return found


def _no_number(text: str) -> NoReturn:
    raise ValueError(f"{text} is not a number in JSON")


def _check_text(value: object, depth: int) -> None:
    """Escapes can write halves of characters that no file can hold."""
    if depth == 0:
        raise RecursionError
    if isinstance(value, str):
        try:
            value.encode()
        except UnicodeEncodeError:
            raise ValueError("a text is not valid Unicode") from None
    elif isinstance(value, list):
        for part in value:
            _check_text(part, depth - 1)
    elif isinstance(value, dict):
        for name, part in value.items():
            _check_text(name, 1)
            _check_text(part, depth - 1)


def _as_row(value: object, place: str) -> Row:
    if not isinstance(value, dict):
        raise UserError(f"{place} is {quoted(value)}, but it must be an object")
    return value
