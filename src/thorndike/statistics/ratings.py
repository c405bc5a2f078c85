"""Elo ratings of a pool of players from the games between them, with intervals.

Davidson's model of ties (1970, JASA 65, 317-328), which is Bradley and Terry's (1952) with draws, and an advantage of moving first, fitted
to all games at once: the most likely ratings under a weak prior, and intervals by the curvature of the likelihood there (Coulom's BayesElo
does the same by another model of draws). A fit to all games is no running total: the order of games does not matter.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thorndike.errors import UserError

Floats = NDArray[np.float64]
ELO = 400 / math.log(10)
"""Points of one unit of log-odds."""
_RATING_PRIOR, _ADVANTAGE_PRIOR = 1000 / ELO, 200 / ELO
"""Standard deviations: they keep a player who won all games at a finite rating."""
_DRAW_PRIOR = 2.0
_Z95 = 1.959963984540054
_STEPS = 100


class Games(NamedTuple):
    """The games of two players in which the first moved first."""

    first: int
    second: int
    wins: int
    draws: int
    losses: int


class Rating(NamedTuple):
    """Of one player, in Elo points; the mean of the pool is 0."""

    elo: float
    low: float
    high: float
    games: int
    score: float
    """Share of the points, a draw being half a point."""


class Ratings(NamedTuple):
    """Of a pool."""

    players: tuple[Rating, ...]
    first_move: float
    """Elo points that moving first is worth."""


def fit_ratings(number: int, games: Sequence[Games]) -> Ratings:
    """Ratings of players ``0`` to ``number - 1``. Raises UserError where there is nothing to rate."""
    if number < 2 or not any(row.wins + row.draws + row.losses for row in games):
        raise UserError("ratings need at least two players, and a game between them")
    features, counts = _design(number, games)
    precision = np.full(number + 2, _RATING_PRIOR**-2)
    precision[number:] = _ADVANTAGE_PRIOR**-2, _DRAW_PRIOR**-2
    parameters = np.zeros(number + 2)
    for _ in range(_STEPS):
        gradient, curvature = _derivatives(parameters, features, counts, precision)
        step = np.linalg.solve(curvature, gradient)
        # The likelihood is concave, but a whole step from far away may overshoot.
        parameters -= step / max(1.0, float(np.abs(step).max()))
        if np.abs(step).max() < 1e-10:
            break
    covariance = np.linalg.inv(_derivatives(parameters, features, counts, precision)[1])[:number, :number]
    centring = np.eye(number) - 1 / number
    centred = centring @ parameters[:number]
    spread = np.sqrt(np.diag(centring @ covariance @ centring.T))
    rows = []
    for player in range(number):
        points, played = _points(player, games)
        low, high = (centred[player] + sign * _Z95 * spread[player] for sign in (-1, 1))
        rows.append(Rating(centred[player] * ELO, low * ELO, high * ELO, played, points / played if played else math.nan))
    return Ratings(tuple(rows), float(parameters[number] * ELO))


def elo_difference(score: float) -> float:
    """Elo points between two players of whom the better takes this share of the points; infinite at 0 and 1."""
    if score <= 0 or score >= 1:
        return math.copysign(math.inf, score - 0.5)
    return ELO * math.log(score / (1 - score))


def _design(number: int, games: Sequence[Games]) -> tuple[Floats, Floats]:
    """``[rows, outcomes, parameters]`` and ``[rows, outcomes]``: win, draw, loss are a softmax of linear terms."""
    features = np.zeros((len(games), 3, number + 2))
    for row, played in zip(features, games, strict=True):
        for outcome, sign in ((0, 0.5), (2, -0.5)):
            row[outcome, played.first] += sign
            row[outcome, played.second] -= sign
            row[outcome, number] += sign
        row[1, number + 1] = 1.0
    return features, np.array([[row.wins, row.draws, row.losses] for row in games], float)


def _derivatives(parameters: Floats, features: Floats, counts: Floats, precision: Floats) -> tuple[Floats, Floats]:
    """Gradient and curvature of the negative logarithm of the posterior."""
    logits = features @ parameters
    chances = np.exp(logits - logits.max(axis=1, keepdims=True))
    chances /= chances.sum(axis=1, keepdims=True)
    total = counts.sum(axis=1)
    mean = np.einsum("ro,rop->rp", chances, features)
    gradient = precision * parameters - np.einsum("ro,rop->p", counts, features) + total @ mean
    second = np.einsum("r,ro,rop,roq->pq", total, chances, features, features)
    return gradient, second - np.einsum("r,rp,rq->pq", total, mean, mean) + np.diag(precision)


def _points(player: int, games: Sequence[Games]) -> tuple[float, int]:
    points, played = 0.0, 0
    for row in games:
        if player in (row.first, row.second):
            played += row.wins + row.draws + row.losses
            points += (row.wins if player == row.first else row.losses) + row.draws / 2
    return points, played
