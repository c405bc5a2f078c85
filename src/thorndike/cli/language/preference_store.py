"""Arguments of the verbs about preferences, and the store that they name."""

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from thorndike.cli.parser import Parser
from thorndike.errors import UserError
from thorndike.suggestions import did_you_mean

if TYPE_CHECKING:
    from thorndike.language.preferences.store import Store

PROJECT = "default"


def add_store_arguments(parser: Parser) -> None:
    """Where the store is, and which project in it."""
    parser.add_argument("--db", required=True, metavar="STORE", help="a SQLite file, or postgresql://USER@HOST/NAME")
    parser.add_argument("--project", default=PROJECT, metavar="NAME", help=f"which of the store's projects (default: {PROJECT})")


@contextmanager
def opened_store(where: str, new: bool = False) -> Iterator["Store"]:
    """The store; ``new``: made where there is none. Raises ``UserError`` where SQLAlchemy is missing, or it cannot be opened."""
    if find_spec("sqlalchemy") is None:
        raise UserError("preferences need SQLAlchemy, which is not installed: pip install 'thorndike[language]'")
    if not new and "://" not in where and Path(where).parent.is_dir() and not Path(where).exists():
        # SQLite would make an empty file of a name that was mistyped.
        raise UserError(f"there is no store {where}; put something in: thorndike language import FILE --db {where}")
    from thorndike.language.preferences.store import Store

    with Store(where) as store:
        yield store


def existing_project(store: "Store", name: str) -> int:
    """The number of a project. Raises ``UserError`` where the store has none of that name."""
    projects = store.projects()
    if name not in projects:
        raise UserError(f"the store has no project '{name}'{did_you_mean(name, projects)}; put something in: thorndike language import")
    return projects[name]


def media_folder(where: str, given: Path | None) -> Path:
    """The folder that a store's clips lie in: where the store is, unless another is given. Raises ``UserError`` for what is none."""
    media = given if given is not None else Path("." if "://" in where else Path(where).parent)
    if not media.is_dir():
        raise UserError(f"--media {media} is not a folder")
    return media


def share(text: str) -> float:
    """A number from 0 to 1."""
    try:
        number = float(text)
    except ValueError:
        number = -1.0
    if not 0 <= number <= 1:
        raise argparse.ArgumentTypeError(f"expected a number from 0 to 1, such as 0.05; got '{text}'")
    return number
