"""Profiles and curves against slow loops."""

import numpy as np
import pytest
import scipy.stats

from thorndike.errors import UserError
from thorndike.statistics.profiles import performance_profile, sample_efficiency

SCORES = np.random.default_rng(0).normal(size=(8, 3))


def test_a_profile_is_the_share_of_scores_above_each_threshold():
    thresholds = [-9.0, -0.5, 0.0, 0.7, 9.0]
    band = performance_profile(SCORES, thresholds)
    assert band.value == pytest.approx([sum(score > threshold for score in SCORES.flat) / 24 for threshold in thresholds], abs=1e-12)
    assert (band.value[0], band.low[0], band.value[-1], band.high[-1]) == (1.0, 1.0, 0.0, 0.0)


def test_a_score_at_a_threshold_is_not_above_it():
    assert performance_profile([1.0, 2.0], [1.0, 2.0]).value.tolist() == [0.5, 0.0]


def test_the_band_of_a_profile_is_that_of_a_slow_stratified_bootstrap():
    generator = np.random.default_rng(1)
    drawn = [np.stack([SCORES[generator.integers(8, size=8), task] for task in range(3)], axis=1) for _ in range(2_000)]
    low, high = np.quantile([np.mean(table > 0.2) for table in drawn], [0.025, 0.975])
    band = performance_profile(SCORES, [0.2])
    assert (band.low[0], band.high[0]) == pytest.approx((low, high), abs=1 / 24 + 1e-9)


def test_sample_efficiency_is_the_interquartile_mean_at_each_point_with_its_bootstrap_interval():
    values = SCORES[:, :, None] + np.array([0.0, 5.0])
    band = sample_efficiency(values)
    generator = np.random.default_rng(2)
    drawn = [np.stack([SCORES[generator.integers(8, size=8), task] for task in range(3)], axis=1) for _ in range(2_000)]
    low, high = np.quantile([scipy.stats.trim_mean(table, 0.25, axis=None) for table in drawn], [0.025, 0.975])
    middle = scipy.stats.trim_mean(SCORES, 0.25, axis=None)
    assert band.value == pytest.approx([middle, middle + 5], abs=1e-12)
    assert (band.low[0], band.high[0]) == pytest.approx((low, high), abs=0.06 * (high - low))
    # The same seeds are drawn at every point.
    assert band.low + 5 == pytest.approx([band.low[1], band.low[1] + 5])


def test_what_is_not_known_of_every_seed_is_refused():
    with pytest.raises(UserError, match="finite"):
        sample_efficiency([[[1.0, np.nan]]])
    with pytest.raises(UserError, match=r"\[seeds, tasks, points\]"):
        sample_efficiency([[1.0, 2.0]])
