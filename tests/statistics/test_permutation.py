"""The permutation test against SciPy's, against every split written out, and where few seeds make it delicate."""

import numpy as np
import pytest
import scipy.stats

from thorndike.statistics.estimates import plain_mean, pooled_iqm
from thorndike.statistics.permutation import permutation_p_value

FIRST, SECOND = np.random.default_rng(0).normal([[0.0], [0.8]], [[1.0], [2.0]], size=(2, 6))


def p_value(first, second, statistic=plain_mean, **options):
    return permutation_p_value(np.reshape(first, (len(first), -1)), np.reshape(second, (len(second), -1)), statistic, **options)


def distance(location):
    """What is permuted, for SciPy."""

    def apart(first, second, axis=-1):
        error = np.sqrt(first.var(axis, ddof=1) / first.shape[axis] + second.var(axis, ddof=1) / second.shape[axis])
        return np.abs(location(first, axis) - location(second, axis)) / error

    return apart


def iqm(scores, axis):
    return scipy.stats.trim_mean(scores, 0.25, axis)


@pytest.mark.parametrize("sizes", [(6, 6), (5, 4), (2, 6)])
@pytest.mark.parametrize(("statistic", "location"), [(plain_mean, np.mean), (pooled_iqm, iqm)], ids=["mean", "iqm"])
def test_all_splits_are_tried_as_scipy_does(sizes, statistic, location):
    first, second = FIRST[: sizes[0]], SECOND[: sizes[1]]
    options = {"vectorized": True, "n_resamples": np.inf, "alternative": "greater"}
    expected = scipy.stats.permutation_test((first, second), distance(location), **options)
    assert p_value(first, second, statistic) == pytest.approx(expected.pvalue, abs=1e-12)


def test_random_splits_come_close_to_all_splits():
    exact = p_value(FIRST, SECOND)
    assert p_value(FIRST, SECOND, permutations=900) == pytest.approx(exact, abs=0.06)
    assert p_value(FIRST, SECOND, permutations=900) != exact


def test_random_splits_never_give_zero():
    assert p_value(np.arange(20.0), np.arange(20.0) + 1e6, permutations=999) == pytest.approx(1 / 1000)


def test_each_task_is_split_on_its_own():
    generator = np.random.default_rng(1)
    tasks = np.array([0.0, 1e3])
    first, second = generator.normal(size=(5, 2)) + tasks, generator.normal(2.5, size=(5, 2)) + tasks
    assert p_value(first, second, permutations=2_000) < 0.01


def test_several_tasks_give_uniform_p_values_if_nothing_differs():
    generator = np.random.default_rng(2)
    found = [p_value(*generator.exponential(size=(2, 5, 3)), pooled_iqm, permutations=200) for _ in range(200)]
    assert np.mean(np.array(found) <= 0.2) == pytest.approx(0.2, abs=0.08)


@pytest.mark.parametrize("statistic", [plain_mean, pooled_iqm])
def test_scores_without_spread(statistic):
    assert p_value([500.0] * 5, [500.0] * 5, statistic) == 1.0
    assert p_value([500.0] * 5, [0.1 + 0.2] * 5, statistic) == pytest.approx(2 / 252)


@pytest.mark.parametrize("statistic", [plain_mean, pooled_iqm])
def test_five_full_scores_against_five_lower_ones_are_as_far_apart_as_can_be(statistic):
    assert p_value([500.0] * 5, [380.0, 391.0, 402.0, 413.0, 430.0], statistic) == pytest.approx(2 / 252)


def test_a_single_seed_gives_no_p_value():
    assert np.isnan(p_value([1.0], [2.0, 3.0, 4.0]))


def test_unequal_spreads_of_unequal_numbers_of_seeds_are_not_taken_for_a_difference():
    generator = np.random.default_rng(4)
    found = [p_value(generator.normal(0, 1, 20), generator.normal(0, 5, 5), permutations=300) for _ in range(300)]
    # Without the standard errors it would be a third.
    assert np.mean(np.array(found) <= 0.05) < 0.16
