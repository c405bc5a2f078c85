"""Tables for people: rows of facts on a terminal."""

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from thorndike.cli.answer import printable

if TYPE_CHECKING:
    from rich.table import Table


def table(rows: Sequence[Mapping[str, object]]) -> "Table":
    """Rows under the names of the first one's fields; numbers stand to the right."""
    from rich.markup import escape
    from rich.table import Table

    drawn = Table(box=None, padding=(0, 2, 0, 0), header_style="bold")
    for number, name in enumerate(rows[0]):
        is_number = any(isinstance(row[name], int | float) for row in rows)
        drawn.add_column(name.replace("_", " "), justify="right" if is_number else "left", overflow="fold", no_wrap=number == 0)
    for row in rows:
        drawn.add_row(*(escape(text_of(value)) for value in row.values()))
    return drawn


def facts_table(title: str, facts: Mapping[str, object]) -> "Table":
    """One fact a line under a title."""
    from rich.markup import escape
    from rich.table import Table

    drawn = Table(title=escape(title), title_justify="left", title_style="bold", show_header=False, box=None, padding=(0, 2, 0, 0))
    for name, value in facts.items():
        drawn.add_row(name, escape(text_of(value)))
    return drawn


def text_of(value: object) -> str:
    """A value in the fewest words that say it."""
    match value:
        case None:
            return "-"
        case bool():
            return str(value)
        case str():
            return printable(value)
        case int():
            return f"{value:,}"
        case float():
            return f"{value:.6g}"
        case Mapping():
            return ", ".join(f"{name} {text_of(part)}" for name, part in value.items())
        case Sequence():
            return ", ".join(map(text_of, value))
    return str(value)


def mean(values: object) -> object:
    """The mean over the seeds that have a value, None if none has; what is no list stays as it is."""
    if not isinstance(values, list):
        return values
    known = [value for value in values if value is not None and math.isfinite(value)]
    return sum(known) / len(known) if known else None
