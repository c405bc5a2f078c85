"""Files of preferences as comparisons: TRL's columns, and ``p_chosen``, ``weight`` and ``prompt_id`` where a store wrote them."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from thorndike.errors import UserError
from thorndike.language.comparisons import Comparison, Pair
from thorndike.language.data import Row, Text, completion_tokens, format_of, prompt_tokens, read_rows, text_at
from thorndike.language.preferences.records import with_explicit_prompt
from thorndike.language.tokenizer import Tokenizer
from thorndike.training.json_files import quoted


def read_comparisons(paths: Iterable[Path], tokenizer: Tokenizer) -> list[Comparison]:
    """The preferences of files; rows of one ``prompt_id`` and prompt are one comparison of all their texts.

    Raises ``UserError`` for a row that is no preference, naming file and row.
    """
    groups: dict[tuple[object, tuple[int, ...]], dict[tuple[int, ...], int]] = {}
    pairs: dict[tuple[object, tuple[int, ...]], list[Pair]] = {}
    for path in paths:
        for number, row in enumerate(read_rows(path)):
            prompt, chosen, rejected = _texts(row, tokenizer)
            identity = row.content.get("prompt_id")
            group = (f"{path} {number}" if identity is None else str(identity), prompt)
            texts = groups.setdefault(group, {})
            first, second = (texts.setdefault((*prompt, *each), len(texts)) for each in (chosen, rejected))
            if first == second:
                raise UserError(f"{row.where}: chosen and rejected are the same text: leave it out")
            pairs.setdefault(group, []).append(Pair(first, second, _number(row, "p_chosen", 1.0, 1.0), _number(row, "weight", 1.0)))
    return [Comparison(tuple(texts), len(group[1]), tuple(pairs[group])) for group, texts in groups.items()]


def read_prompts(paths: Iterable[Path]) -> list[Text]:
    """The texts and conversations of a column ``prompt``. Raises ``UserError`` for what is neither, naming file and row."""
    return [text_at(row, "prompt") for path in paths for row in read_rows(path)]


def _texts(row: Row, tokenizer: Tokenizer) -> tuple[tuple[int, ...], Sequence[int], Sequence[int]]:
    if format_of(row) != "preference":
        raise UserError(f"{row.where}: expected a preference, with the columns chosen and rejected, and perhaps prompt")
    for column in ("chosen", "rejected"):
        text_at(row, column)
    whole = row._replace(content=_explicit(row.content))
    prompt = text_at(whole, "prompt")
    tokens = tuple(prompt_tokens(prompt, tokenizer))
    if not tokens:
        raise UserError(f"{row.where}: the prompt has no tokens")
    chosen, rejected = (completion_tokens(prompt, text_at(whole, name), tokenizer, row.where) for name in ("chosen", "rejected"))
    return tokens, chosen, rejected


def _explicit(content: Mapping[str, object]) -> dict[str, object]:
    return dict(with_explicit_prompt(content))


def _number(row: Row, column: str, default: float, most: float = float("inf")) -> float:
    value = row.content.get(column)
    if value is None:
        return default
    if not isinstance(value, int | float) or isinstance(value, bool) or not 0.0 <= value <= most:
        raise UserError(f"{row.where}: {column} is {quoted(value)}; expected a number from 0{'' if most > 1 else ' to 1'}")
    return float(value)
