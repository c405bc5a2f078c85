"""The result of many games between two players, with how sure it is."""

from collections.abc import Sequence
from typing import NamedTuple

from thorndike.statistics.estimates import wilson_interval
from thorndike.statistics.ratings import elo_difference

Interval = tuple[float, float]


class Counts(NamedTuple):
    """Of one player."""

    wins: int
    draws: int
    losses: int

    @property
    def games(self) -> int:
        """All of them."""
        return sum(self)


class Tally(NamedTuple):
    """Of one player against another; the interval is Wilson's with a draw as half a win, which is wide where many games are drawn."""

    total: Counts
    moving_first: Counts
    moving_second: Counts
    score: float
    """Share of the points; NaN without games."""
    score_ci95: Interval
    elo: float
    """Points that the player is better by; infinite where all games were won."""
    elo_ci95: Interval


def tally(results: Sequence[tuple[int, float]]) -> Tally:
    """``results``: whether the player moved first (0) or second (1), and the score of whoever moved first: 1, 0.5 or 0."""
    by_place = [[score if place == 0 else 1 - score for where, score in results if where == place] for place in (0, 1)]
    first, second = (Counts(scores.count(1.0), scores.count(0.5), scores.count(0.0)) for scores in by_place)
    total = Counts(*(a + b for a, b in zip(first, second, strict=True)))
    nothing = float("nan")
    if total.games == 0:
        return Tally(total, first, second, nothing, (nothing, nothing), nothing, (nothing, nothing))
    points = total.wins + total.draws / 2
    low, high = wilson_interval(points, total.games)
    elo_ci95 = elo_difference(low), elo_difference(high)
    return Tally(total, first, second, points / total.games, (low, high), elo_difference(points / total.games), elo_ci95)
