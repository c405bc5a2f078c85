"""Data of language models in TRL's formats, recognised by their columns; every complaint names the file and the row.

Language modelling: ``text``, or ``messages``. Prompt and completion: ``prompt`` and ``completion``. Preferences: ``chosen``, ``rejected``
and perhaps ``prompt``. Judged completions: ``prompt``, ``completion``, ``label``. Prompts alone: ``prompt``. A text is a string, or a
conversation: a list of ``{"role": ..., "content": ...}``. Files: ``.jsonl``, ``.json`` (a list), ``.csv``, ``.parquet`` (with pyarrow).
"""

import csv
import io
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Literal, NamedTuple, NoReturn, TypeAlias, cast

from thorndike.errors import UserError
from thorndike.language.tokenizer import Tokenizer
from thorndike.training.json_files import Json, quoted

_LONGEST_CELL = 2**31 - 1

Format: TypeAlias = Literal["language_modelling", "prompt_completion", "preference", "judged", "prompt"]
Conversation: TypeAlias = list[dict[str, object]]
Text: TypeAlias = str | Conversation


class Row(NamedTuple):
    """One example, and where it stands."""

    content: Json
    where: str
    """``data.jsonl, row 3``, counted from 1."""


class TokenRow(NamedTuple):
    """One text in tokens."""

    tokens: list[int]
    learn: list[bool]
    """Whether a token is to be learnt, or only read."""


def read_rows(path: Path) -> list[Row]:
    """The rows of a file. Raises ``UserError`` for one that cannot be read, naming the row."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}") from error
    readers = {".jsonl": _json_lines, ".json": _json_list, ".csv": _csv_rows, ".parquet": _parquet_rows}
    if path.suffix not in readers:
        raise UserError(f"{path}: expected a file that ends in {', '.join(readers)}")
    rows = readers[path.suffix](data, path)
    if not rows:
        raise UserError(f"{path} has no rows")
    return rows


def format_of(row: Row) -> Format:
    """What a row is, by its columns. Raises ``UserError`` if it is nothing known."""
    columns = row.content.keys()
    if "chosen" in columns and "rejected" in columns:
        return "preference"
    if "prompt" in columns and "completion" in columns:
        return "judged" if "label" in columns else "prompt_completion"
    if "text" in columns or "messages" in columns:
        return "language_modelling"
    if "prompt" in columns:
        return "prompt"
    known = "text | messages | prompt | prompt, completion[, label] | [prompt,] chosen, rejected"
    raise UserError(f"{row.where}: its columns {sorted(columns)} are none of: {known}")


def text_at(row: Row, column: str) -> Text:
    """A row's text or conversation. Raises ``UserError`` for anything else, and for what is empty."""
    value = row.content.get(column)
    if isinstance(value, str) and value:
        # A lone surrogate, which JSON may hold, is no Unicode: no tokenizer takes it.
        if not _encodable(value):
            raise UserError(f"{row.where}: {column} holds half a character (a lone surrogate): mend its encoding")
        return value
    if not isinstance(value, list) or not value:
        expected = "a text, or a list of messages"
        raise UserError(f"{row.where}: {column} is {'empty' if value in ('', []) else quoted(value)}; expected {expected}")
    for message in value:
        if not isinstance(message, dict) or not isinstance(message.get("role"), str) or not isinstance(message.get("content"), str):
            raise UserError(f"{row.where}: {column} has the message {quoted(message)}; expected an object with role and content")
        if not _encodable(message["content"]):
            raise UserError(f"{row.where}: {column} holds half a character (a lone surrogate): mend its encoding")
    return cast(Conversation, value)


def as_tokens(row: Row, tokenizer: Tokenizer) -> TokenRow:
    """A row of texts, conversations, or prompts and completions, in tokens: what is learnt are texts, completions, and assistants' turns.

    Raises ``UserError`` for a row of another format.
    """
    found = format_of(row)
    if found == "language_modelling":
        if "messages" in row.content:
            return _turns(_conversation(row, "messages"), tokenizer, row.where)
        tokens = _ended(tokenizer.encode(_plain(row, "text")), tokenizer)
        return TokenRow(tokens, [True] * len(tokens))
    if found not in ("prompt_completion", "judged"):
        raise UserError(f"{row.where}: a row of format {found} has nothing to imitate; expected text, messages, or prompt and completion")
    prompt, completion = text_at(row, "prompt"), text_at(row, "completion")
    if isinstance(prompt, str) != isinstance(completion, str):
        raise UserError(f"{row.where}: prompt and completion must both be texts, or both conversations")
    before, after = prompt_tokens(prompt, tokenizer), completion_tokens(prompt, completion, tokenizer, row.where)
    return TokenRow([*before, *after], [False] * len(before) + [True] * len(after))


def prompt_tokens(prompt: Text, tokenizer: Tokenizer) -> list[int]:
    """A prompt as the model reads it before it answers."""
    return tokenizer.encode(prompt) if isinstance(prompt, str) else tokenizer.encode_chat(prompt)


def prompts_tokens(prompts: Sequence[Text], tokenizer: Tokenizer) -> list[list[int]]:
    """The same of many prompts at once."""
    texts = iter(tokenizer.encode_many([each for each in prompts if isinstance(each, str)]))
    return [next(texts) if isinstance(each, str) else tokenizer.encode_chat(each) for each in prompts]


def completion_tokens(prompt: Text, completion: Text, tokenizer: Tokenizer, where: str) -> list[int]:
    """A completion as the model would have written it after the prompt, the end of text included."""
    if isinstance(prompt, str):
        if not isinstance(completion, str):
            raise UserError(f"{where}: the prompt is a text, so the completion must be one")
        return _ended(tokenizer.encode(completion, special=False), tokenizer)
    messages = [{"role": "assistant", "content": completion}] if isinstance(completion, str) else completion
    before, whole = tokenizer.chat(prompt), tokenizer.chat([*prompt, *messages], prompt=False)
    if not whole.startswith(before):
        raise UserError(f"{where}: with this model's chat template an answer does not begin where its prompt ends; give plain texts")
    return tokenizer.encode(whole[len(before) :], special=False)


def tokenize(rows: Iterable[Row], tokenizer: Tokenizer) -> list[TokenRow]:
    """All rows in tokens; they may be of different formats."""
    return [as_tokens(row, tokenizer) for row in rows]


def _turns(messages: Conversation, tokenizer: Tokenizer, where: str) -> TokenRow:
    """A conversation; what the assistant says is learnt."""
    tokens: list[int] = []
    learn: list[bool] = []
    said = ""
    if not any(message["role"] == "assistant" for message in messages):
        raise UserError(f"{where}: messages has no turn of the assistant, so that there is nothing to learn from it")
    for number, message in enumerate(messages):
        if message["role"] != "assistant":
            continue
        before, after = tokenizer.chat(messages[:number]), tokenizer.chat(messages[: number + 1], prompt=False)
        if not before.startswith(said) or not after.startswith(before):
            raise UserError(f"{where}: this model's chat template changes earlier turns; give prompt and completion instead of messages")
        for text, learnt in ((before[len(said) :], False), (after[len(before) :], True)):
            part = tokenizer.encode(text, special=False)
            tokens, learn = [*tokens, *part], [*learn, *[learnt] * len(part)]
        said = after
    return TokenRow(tokens, learn)


def _plain(row: Row, column: str) -> str:
    value = text_at(row, column)
    if not isinstance(value, str):
        raise UserError(f"{row.where}: {column} must be a text; a conversation goes into the column messages")
    return value


def _conversation(row: Row, column: str) -> Conversation:
    value = text_at(row, column)
    if isinstance(value, str):
        raise UserError(f"{row.where}: {column} must be a list of messages; a text goes into the column text")
    return value


def _ended(tokens: list[int], tokenizer: Tokenizer) -> list[int]:
    end = tokenizer.eos_id
    return tokens if end is None or tokens[-1:] == [end] else [*tokens, end]


def _encodable(text: str) -> bool:
    return not any("\ud800" <= character <= "\udfff" for character in text)


def _json_lines(data: bytes, path: Path) -> list[Row]:
    rows = []
    for number, line in enumerate(data.split(b"\n"), 1):
        if line.strip():
            rows.append(_row(parsed_json(line, f"{path}, row {number}"), f"{path}, row {number}"))
    return rows


def _json_list(data: bytes, path: Path) -> list[Row]:
    content = parsed_json(data, str(path))
    if not isinstance(content, list):
        raise UserError(f"{path}: expected a list of objects, got {quoted(content)}; one object a line goes into a .jsonl file")
    return [_row(each, f"{path}, row {number}") for number, each in enumerate(content, 1)]


def _csv_rows(data: bytes, path: Path) -> list[Row]:
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        row = data[: error.start].count(b"\n") + 1
        raise UserError(f"{path}, row {row}: not UTF-8 (byte {error.start}); save the file as UTF-8") from None
    csv.field_size_limit(_LONGEST_CELL)
    reader = csv.DictReader(io.StringIO(text, newline=""), strict=True)
    rows: list[Row] = []
    try:
        names = list(reader.fieldnames or ())
        if len(set(names)) < len(names):
            raise UserError(f"{path}: its first line names a column twice: {', '.join(map(quoted, names))}")
        for number, each in enumerate(reader, 1):
            if None in each or None in each.values():
                raise UserError(f"{path}, row {number}: it has not as many cells as the first line has columns")
            rows.append(Row(dict(each), f"{path}, row {number}"))
    except csv.Error as error:
        raise UserError(f"{path}, row {len(rows) + 1}: {error}") from None
    return rows


def _parquet_rows(data: bytes, path: Path) -> list[Row]:
    try:
        import pyarrow
        from pyarrow import parquet
    except ModuleNotFoundError:
        raise UserError(f"{path}: reading .parquet needs pyarrow: pip install pyarrow; or save it as .jsonl") from None
    try:
        content = parquet.read_table(io.BytesIO(data)).to_pylist()
    except (pyarrow.ArrowException, OSError) as error:
        raise UserError(f"{path} cannot be read: {str(error)[:200]}") from error
    return [_row(each, f"{path}, row {number}") for number, each in enumerate(content, 1)]


def parsed_json(data: bytes, where: str) -> object:
    """What a JSON text holds. Raises ``UserError`` for one that is damaged, or of which something would be lost."""
    try:
        return json.loads(data.decode("utf-8-sig"), object_pairs_hook=_no_name_twice, parse_constant=_no_number)
    except UnicodeDecodeError as error:
        raise UserError(f"{where}: not UTF-8 (byte {error.start}); save the file as UTF-8") from None
    except RecursionError:
        raise UserError(f"{where}: nested too deeply") from None
    except ValueError as error:
        raise UserError(f"{where}: no JSON: {str(error)[:200]}") from None


def _no_name_twice(pairs: list[tuple[str, object]]) -> Json:
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError("an object has a name twice, and one of its values would be lost")
    return found


def _no_number(text: str) -> NoReturn:
    raise ValueError(f"{text} is no number in JSON")


def _row(content: object, where: str) -> Row:
    if not isinstance(content, Mapping) or not all(isinstance(key, str) for key in content):
        raise UserError(f"{where}: expected an object, got {quoted(content)}")
    return Row(dict(content), where)


def conversation_prefix(chosen: Sequence[object], rejected: Sequence[object]) -> int:
    """How many messages, or tokens, two texts begin with in common: the prompt that a row of preferences does not name."""
    shared = 0
    for one, other in zip(chosen, rejected, strict=False):
        if one != other:
            break
        shared += 1
    return shared
