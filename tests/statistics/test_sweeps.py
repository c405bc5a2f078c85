"""Which settings matter: on made-up scores whose truth is known."""

import itertools
import math

import numpy as np
import pytest

from thorndike.statistics.sweeps import Factor, best_trial, effects_of, filled_scores, holm


def grid(levels, seeds, score, seed=0):
    """Scores of every combination of ``levels``, ``score(combination, generator)`` each, and their factors."""
    generator = np.random.default_rng(seed)
    combinations = list(itertools.product(*map(range, levels)))
    scores = np.array([[score(combination, generator) for _ in range(seeds)] for combination in combinations])
    return scores, [Factor(f"f{i}", tuple(each[i] for each in combinations), False) for i in range(len(levels))]


def drawn(trials, seeds, settings, score, seed=0):
    """Scores of random trials whose settings lie in [0, 1]."""
    generator = np.random.default_rng(seed)
    places = generator.random((trials, settings))
    scores = np.array([[score(place, generator) for _ in range(seeds)] for place in places])
    return scores, [Factor(f"f{i}", tuple(places[:, i]), True) for i in range(settings)]


def test_a_strong_setting_matters_and_one_without_effect_does_not():
    scores, factors = grid((3, 3), 10, lambda levels, generator: (0, 10, 4)[levels[0]] + generator.normal())
    strong, none = effects_of(scores, factors, "grid")
    assert (strong.verdict, none.verdict) == ("matters", "does not matter here")
    assert strong.p_value < 0.01 < 0.05 < none.p_value
    assert strong.ci95[0] < 10 < strong.ci95[1] and strong.effect == pytest.approx(10, abs=1)


def test_a_range_that_matters_is_found_among_random_trials():
    scores, factors = drawn(40, 2, 2, lambda place, generator: 10 * math.exp(-(((place[0] - 0.5) / 0.2) ** 2)) + generator.normal())
    peaked, none = effects_of(scores, factors, "random")
    assert peaked.verdict == "matters" and none.verdict == "cannot tell"
    best = max(peaked.points, key=lambda point: point.mean)
    assert best.values[0] < 0.55 and best.values[1] > 0.45


def test_a_setting_that_changes_nothing_at_all_does_not_matter_however_few_the_seeds():
    scores, factors = grid((3, 2), 3, lambda levels, generator: (0, 10, 4)[levels[0]] + generator.normal())
    scores[1::2] = scores[::2]
    effect = effects_of(scores, factors, "grid")[1]
    assert effect.verdict == "does not matter here" and effect.ci95 == pytest.approx((0, 0)) and effect.p_value == 1


def test_equal_scores_of_a_few_seeds_may_be_chance():
    (effect,) = effects_of(np.array([[1.0, 5.0, 2.0, 4.0]] * 2), [Factor("f", (0, 1), False)], "grid")
    assert effect.verdict == "cannot tell"


def test_two_seeds_of_two_values_cannot_tell():
    scores, factors = grid((2,), 2, lambda levels, generator: 10 * levels[0] + generator.normal())
    (effect,) = effects_of(scores, factors, "grid")
    assert effect.verdict == "cannot tell" and effect.effect > 5


def test_of_trials_that_optuna_chose_no_test_is_valid():
    scores, factors = drawn(40, 2, 1, lambda place, generator: 10 * place[0])
    (effect,) = effects_of(scores, factors, "optuna")
    assert effect.verdict == "cannot tell" and math.isnan(effect.p_value)


def test_a_curve_has_the_mean_of_each_value_in_order_of_size():
    factor = Factor("f", (3.0, 1.0, 3.0, 1.0), False)
    other = Factor("g", ("b", "b", "a", "a"), False)
    first, second = effects_of(np.array([[5.0, 7.0], [1.0, 1.0], [9.0, 7.0], [2.0, 2.0]]), [factor, other], "grid")
    assert [(point.values, point.mean, point.trials) for point in first.points] == [((1.0,), 1.5, 2), ((3.0,), 7.0, 2)]
    assert [point.values for point in second.points] == [("b",), ("a",)]
    assert all(point.ci95[0] <= point.mean <= point.ci95[1] for point in (*first.points, *second.points))


def test_a_range_of_whole_numbers_has_no_empty_bins():
    scores = np.arange(24.0)[:, None]
    (effect,) = effects_of(scores, [Factor("f", tuple([1] * 20 + [2, 2, 3, 3]), True)], "random")
    assert sum(point.trials for point in effect.points) == 24 and all(point.trials > 0 for point in effect.points)


def test_the_same_scores_give_the_same_answer():
    scores, factors = grid((2, 2), 3, lambda levels, generator: generator.normal())
    assert effects_of(scores, factors, "grid", seed=1) == effects_of(scores, factors, "grid", seed=1)


def test_a_failed_seed_counts_as_the_worst_that_was_seen():
    assert filled_scores([[1.0, None], [-3.0, 2.0]]).tolist() == [[1.0, -3.0], [-3.0, 2.0]]
    assert filled_scores([[None]]).tolist() == [[0.0]]
    assert best_trial(filled_scores([[1.0, None], [-3.0, 2.0], [0.0, 0.0]])) == 2


def test_holm_multiplies_the_smallest_by_their_number_and_keeps_their_order():
    assert holm([0.04, 0.01, 0.03]) == pytest.approx([0.06, 0.03, 0.06])
    assert holm([0.5, math.nan]) == [0.5, pytest.approx(math.nan, nan_ok=True)]


def intervals_that_hold(seeds, runs=150):
    told = 0
    for run in range(runs):
        scores, factors = grid((2,), seeds, lambda levels, generator: 10 * levels[0] + generator.normal(), seed=run)
        (effect,) = effects_of(scores, factors, "grid", seed=run)
        told += effect.points[1].ci95[0] <= 10 <= effect.points[1].ci95[1]
    return told / runs


@pytest.mark.slow
def test_intervals_hold_the_truth_about_as_often_as_they_say():
    assert intervals_that_hold(10) > 0.9


@pytest.mark.slow
@pytest.mark.parametrize("levels", [(3, 3), (4, 2)])
def test_settings_without_effect_are_rarely_said_to_matter(levels):
    wrong = 0
    for run in range(200):
        scores, factors = grid(levels, 4, lambda _, generator: 500.0 if generator.random() < 0.6 else 100 * generator.random(), seed=run)
        wrong += any(effect.verdict == "matters" for effect in effects_of(scores, factors, "grid", seed=run))
    assert wrong <= 200 * 0.05 + 2 * math.sqrt(200 * 0.05)


@pytest.mark.slow
def test_ranges_without_effect_are_rarely_said_to_matter():
    wrong = 0
    for run in range(200):
        scores, factors = drawn(24, 3, 3, lambda _, generator: generator.normal(), seed=run)
        wrong += any(effect.verdict == "matters" for effect in effects_of(scores, factors, "random", seed=run))
    assert wrong <= 200 * 0.05 + 2 * math.sqrt(200 * 0.05)
