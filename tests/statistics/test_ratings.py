"""Ratings: against a slow likelihood, against players of known strength, and where somebody won everything."""

import math

import numpy as np
import pytest

from thorndike.errors import UserError
from thorndike.statistics.ratings import ELO, Games, elo_difference, fit_ratings

TRUE = np.array([-250.0, -80.0, 0.0, 120.0, 210.0])
FIRST, DRAWS = 40.0, 0.6
"""Elo points of moving first, and Davidson's weight of draws."""


def chances(first, second):
    d = (first - second + FIRST) / ELO
    odds = np.array([math.exp(d / 2), DRAWS, math.exp(-d / 2)])
    return odds / odds.sum()


def simulated(random, games):
    """A round robin with colours swapped."""
    pairs = [(i, j) for i in range(len(TRUE)) for j in range(len(TRUE)) if i != j]
    return [Games(i, j, *map(int, random.multinomial(games, chances(TRUE[i], TRUE[j])))) for i, j in pairs]


def test_intervals_hold_the_truth_as_often_as_they_say():
    random = np.random.default_rng(1)
    held = total = 0
    for _ in range(200):
        found = fit_ratings(len(TRUE), simulated(random, 30))
        held += sum(low <= true <= high for true, (_, low, high, _, _) in zip(TRUE - TRUE.mean(), found.players, strict=True))
        total += len(TRUE)
    # 95 % of 1,000, which are not independent: less than 93 % or more than 97.5 % would not be luck.
    assert 0.93 <= held / total <= 0.975


def test_many_games_find_the_strengths_and_the_advantage():
    found = fit_ratings(len(TRUE), simulated(np.random.default_rng(2), 20_000))
    np.testing.assert_allclose([rating.elo for rating in found.players], TRUE - TRUE.mean(), atol=6)
    assert found.first_move == pytest.approx(FIRST, abs=4)
    assert abs(sum(rating.elo for rating in found.players)) < 1e-6


def test_it_is_the_top_of_the_likelihood():
    games = [Games(0, 1, 7, 3, 5), Games(1, 0, 8, 2, 4)]
    found = fit_ratings(2, games)
    gap = (found.players[0].elo - found.players[1].elo) / ELO

    def slow(gap):
        """The best logarithm of the posterior for this gap, over a grid of the other two numbers."""
        best = -math.inf
        for advantage in np.linspace(-1, 1, 81):
            for draw in np.linspace(-2, 1, 61):
                total = -((gap / 2 * ELO / 1000) ** 2) - (advantage * ELO / 200) ** 2 / 2 - (draw / 2) ** 2 / 2
                for sign, (_, _, wins, draws, losses) in ((1, games[0]), (-1, games[1])):
                    d = sign * gap + advantage
                    norm = math.log(math.exp(d / 2) + math.exp(draw) + math.exp(-d / 2))
                    total += wins * (d / 2 - norm) + draws * (draw - norm) + losses * (-d / 2 - norm)
                best = max(best, total)
        return best

    near = {step: slow(gap + step) for step in (-0.2, 0.0, 0.2)}
    assert near[0.0] > near[-0.2]
    assert near[0.0] > near[0.2]


def test_who_wins_everything_gets_a_finite_rating_and_a_wide_interval():
    found = fit_ratings(2, [Games(0, 1, 10, 0, 0), Games(1, 0, 0, 0, 10)])
    best, worst = found.players
    assert 200 < best.elo < 1000
    assert best.elo == pytest.approx(-worst.elo)
    assert best.low < best.elo - 80
    assert (best.games, best.score) == (20, 1.0)


def test_nothing_to_rate_is_told():
    with pytest.raises(UserError, match="at least two players"):
        fit_ratings(2, [Games(0, 1, 0, 0, 0)])


def test_elo_points_of_a_score():
    assert elo_difference(10 / 11) == pytest.approx(400)
    assert elo_difference(0.5) == 0
    assert elo_difference(0.0) == -math.inf
