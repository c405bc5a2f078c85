"""What goes into a preference store and comes out of it."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple, TypeAlias

from thorndike.errors import UserError
from thorndike.language.preferences.schema import VERDICTS
from thorndike.training.json_files import quoted

Content: TypeAlias = Mapping[str, object]
"""Anything that can be shown: an object with ``text``, ``messages`` or ``media`` (a file) in it."""

_LONGEST_REASON = 10_000
_LONGEST_TIME_MS = 7 * 24 * 3600 * 1000
STRENGTHS = {1: "slightly", 2: "clearly", 3: "much"}


class Candidate(NamedTuple):
    """One of the things that are compared."""

    content: Content
    made_by: str = ""
    """The model; raters never see it."""
    details: Mapping[str, object] = {}
    """What its maker knows of it: seed, temperature, log-probability."""


class NewItem(NamedTuple):
    """A question to be asked: which of these candidates is best?"""

    prompt: Content
    candidates: Sequence[Candidate]
    raters: int = 1
    priority: float = 0.0
    best: int | None = None
    """The position of the candidate that is known to be best: a gold question, which every rater gets."""
    source: str = ""


class Shown(NamedTuple):
    """What a rater sees."""

    assignment: int
    prompt: Content
    candidates: tuple[Content, ...]
    """In the order in which this rater sees them."""


class Response(NamedTuple):
    """What a rater said of what was shown."""

    assignment: int
    verdict: str
    """One of ``VERDICTS``; ``a`` is what was shown first."""
    request: str
    """A name that only this response has: sent again, it is the same response, not another."""
    ranks: Sequence[int] | None = None
    """With ``ranking``: the rank of each candidate, in the order shown; 0 is best, equal ranks tie."""
    strength: int | None = None
    reason: str = ""
    milliseconds: int | None = None
    client: str = ""


class Judged(NamedTuple):
    """A judgement that stands."""

    item: int
    prompt: int
    candidates: tuple[int, ...]
    """Their numbers, by position."""
    rater: str
    verdict: str
    ranks: tuple[int, ...] | None
    """By position, whatever the order shown; None where it was skipped."""
    shown: tuple[int, ...]
    """The positions in the order in which they were shown."""
    repeated: bool
    best: int | None
    """Of a gold question: the position known to be best."""
    strength: int | None
    milliseconds: int | None
    reason: str


def check_response(response: Response) -> None:
    """Raises ``UserError`` for what no rater can have said."""
    if response.verdict not in VERDICTS:
        raise UserError(f"the verdict is {quoted(response.verdict)}, but it must be one of {', '.join(VERDICTS)}")
    if not 0 < len(response.request) <= 100 or not response.request.isprintable():
        raise UserError(f"the request is {quoted(response.request)}, but it must be a name of 1 to 100 printable characters")
    if not response.client.isprintable():
        raise UserError(f"the client is {quoted(response.client)}, but it must be printable")
    if response.strength is not None and response.strength not in STRENGTHS:
        raise UserError(f"the strength is {quoted(response.strength)}, but it must be 1 (slightly), 2 (clearly) or 3 (much)")
    if len(response.reason) > _LONGEST_REASON:
        raise UserError(f"the reason has {len(response.reason):,} characters, {_LONGEST_REASON:,} are allowed")
    if "\0" in response.reason or any("\ud800" <= each <= "\udfff" for each in response.reason):
        raise UserError("the reason holds what is no text")
    if response.milliseconds is not None and not 0 <= response.milliseconds <= _LONGEST_TIME_MS:
        raise UserError(f"the time is {quoted(response.milliseconds)} ms, but it must be from 0 to a week")
    if (response.ranks is not None) != (response.verdict == "ranking"):
        raise UserError("ranks belong to the verdict 'ranking', and to no other")


def ranks_by_position(response: Response, shown: Sequence[int]) -> list[int] | None:
    """The rank of every candidate by position, 0 the best, without gaps; None where nothing was said. Raises ``UserError`` for a misfit."""
    count = len(shown)
    match response.verdict:
        case "skip":
            return None
        case "tie" | "both_bad":
            return [0] * count
        case "a" | "b" if count != 2:
            raise UserError(f"'{response.verdict}' is a verdict on two candidates, and there are {count}: give a ranking")
        case "a" | "b":
            said: Sequence[int] = (0, 1) if response.verdict == "a" else (1, 0)
        case _:
            said = response.ranks or ()
    if len(said) != count or not all(type(rank) is int and rank >= 0 for rank in said):
        raise UserError(f"the ranks are {quoted(said)}, but {count} whole numbers from 0 are expected, one a candidate")
    dense = {rank: place for place, rank in enumerate(sorted(set(said)))}
    ranks = [0] * count
    for position, rank in zip(shown, said, strict=True):
        ranks[position] = dense[rank]
    return ranks
