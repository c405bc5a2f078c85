"""Estimates against slow loops, SciPy and published values."""

import itertools

import numpy as np
import pytest
import scipy.stats

from thorndike.errors import UserError
from thorndike.statistics.estimates import (
    interquartile_mean,
    mean_interval_over_seeds,
    stratified_bootstrap_interval,
    summary,
    wilson_interval,
)

SCORES = np.random.default_rng(0).gamma(2.0, 3.0, size=(10, 4))


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 7, 8, 10, 40])
def test_interquartile_mean_is_scipys_trimmed_mean(count):
    scores = SCORES.reshape(-1)[:count]
    assert interquartile_mean(scores) == pytest.approx(scipy.stats.trim_mean(scores, 0.25), rel=1e-12)


def test_interquartile_mean_pools_runs_and_tasks():
    assert interquartile_mean(SCORES) == pytest.approx(scipy.stats.trim_mean(SCORES, 0.25, axis=None), rel=1e-12)


def test_interquartile_mean_ignores_both_tails():
    assert interquartile_mean([-1e9, 1, 2, 3, 4, 1e9, 2.5, 2.5]) == pytest.approx((2 + 2.5 + 2.5 + 3) / 4)


def test_bootstrap_agrees_with_every_possible_resample():
    scores = np.array([1.0, 2.0, 4.0, 8.0, 16.0])
    means = [np.mean(drawn) for drawn in itertools.product(scores, repeat=5)]
    expected = np.quantile(means, [0.025, 0.975])
    interval = stratified_bootstrap_interval(scores, lambda tables: tables.mean(axis=(1, 2)))
    assert interval == pytest.approx(expected, abs=0.15)


def test_bootstrap_agrees_with_a_slow_stratified_loop():
    generator = np.random.default_rng(1)
    values = []
    for _ in range(4_000):
        drawn = np.stack([SCORES[generator.integers(10, size=10), task] for task in range(4)], axis=1)
        values.append(scipy.stats.trim_mean(drawn, 0.25, axis=None))
    assert stratified_bootstrap_interval(SCORES) == pytest.approx(np.quantile(values, [0.025, 0.975]), abs=0.08)


def test_bootstrap_keeps_strata_apart():
    constant_tasks = np.tile([0.0, 100.0], (10, 1))
    assert stratified_bootstrap_interval(constant_tasks, lambda tables: tables.mean(axis=(1, 2))) == (50.0, 50.0)


def test_bootstrap_is_the_same_each_time_and_changes_with_the_seed():
    first = stratified_bootstrap_interval(SCORES, resamples=1_000)
    assert first == stratified_bootstrap_interval(SCORES, resamples=1_000)
    assert first != stratified_bootstrap_interval(SCORES, resamples=1_000, seed=1)


def test_bootstrap_in_chunks_covers_every_resample(monkeypatch):
    seen = []

    def count(tables):
        seen.append(len(tables))
        return tables.mean(axis=(1, 2))

    monkeypatch.setattr("thorndike.statistics.estimates._CELLS_AT_ONCE", 400)
    stratified_bootstrap_interval(SCORES, count, resamples=95)
    assert seen == [10] * 9 + [5]


def test_bootstrap_covers_the_truth_about_as_often_as_it_says():
    generator = np.random.default_rng(3)
    hits = 0
    for trial in range(200):
        low, high = stratified_bootstrap_interval(
            generator.normal(size=20), lambda tables: tables.mean(axis=(1, 2)), resamples=1_000, seed=trial
        )
        hits += low <= 0 <= high
    assert 0.87 <= hits / 200 <= 0.98


@pytest.mark.parametrize(("successes", "trials"), [(0, 10), (1, 10), (5, 10), (10, 10), (81, 263), (0, 1000)])
def test_wilson_interval_is_scipys(successes, trials):
    expected = scipy.stats.binomtest(successes, trials).proportion_ci(method="wilson")
    assert wilson_interval(successes, trials) == pytest.approx((expected.low, expected.high), abs=1e-12)


@pytest.mark.parametrize(("successes", "trials"), [(-1, 10), (11, 10), (0, 0)])
def test_wilson_interval_refuses_impossible_counts(successes, trials):
    with pytest.raises(UserError, match="successes"):
        wilson_interval(successes, trials)


def test_summary_counts_each_seed_once():
    result = summary([[0.0, 2.0], [10.0, 12.0], [20.0, 22.0], [30.0, 32.0]])
    assert result.per_seed == (1.0, 11.0, 21.0, 31.0)
    assert (result.mean, result.iqm, result.min, result.max) == (16.0, 16.0, 1.0, 31.0)
    assert result.ci95 == stratified_bootstrap_interval([1.0, 11.0, 21.0, 31.0], lambda tables: tables.mean(axis=(1, 2)))
    assert result.iqm_ci95 == stratified_bootstrap_interval([1.0, 11.0, 21.0, 31.0])


def test_one_failed_seed_moves_the_mean_and_the_minimum_but_not_the_interquartile_mean():
    result = summary([500.0] * 9 + [10.0])
    assert (result.mean, result.iqm, result.min) == (451.0, 500.0, 10.0)
    assert result.ci95[0] < 451.0 < result.ci95[1]


def test_summary_of_one_seed_gives_the_interval_over_its_episodes():
    result = summary([[1.0, 2.0, 3.0, 4.0]])
    assert result.mean == result.iqm == result.min == 2.5
    assert 1.0 < result.ci95[0] < 2.5 < result.ci95[1] < 4.0


def test_summary_of_equal_seeds_has_no_width():
    assert summary(np.full((8, 100), 500.0)).ci95 == (500.0, 500.0)


@pytest.mark.parametrize("scores", [[], [1.0, float("nan")], [float("inf")]])
def test_scores_that_are_no_numbers_are_refused(scores):
    with pytest.raises(UserError, match="expected finite scores"):
        summary(scores)


def test_curve_interval_is_the_bootstrap_at_each_point():
    curves = np.random.default_rng(2).normal(size=(3, 10)) + np.array([[0.0], [5.0], [9.0]])
    mean, low, high = mean_interval_over_seeds(curves)
    assert mean == pytest.approx(curves.mean(axis=1))
    for point in range(3):
        expected = stratified_bootstrap_interval(curves[point], lambda tables: tables.mean(axis=(1, 2)))
        assert (low[point], high[point]) == pytest.approx(expected, abs=0.06)


def test_curve_interval_skips_seeds_that_have_nothing_yet():
    mean, low, high = mean_interval_over_seeds([[np.nan, np.nan], [np.nan, 3.0], [1.0, 3.0]])
    assert np.isnan([mean[0], low[0], high[0]]).all()
    assert (mean[1], low[1], high[1]) == (3.0, 3.0, 3.0)
    assert (mean[2], low[2], high[2]) == (2.0, 1.0, 3.0)
