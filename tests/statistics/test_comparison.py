"""Verdicts that are seldom wrong, and numbers that are rliable's."""

import itertools
import math

import numpy as np
import pytest

from thorndike.errors import UserError
from thorndike.statistics.comparison import (
    common_scale,
    compare_scores,
    probability_of_improvement,
    rescaled,
    seeds_needed,
    standing,
)
from thorndike.statistics.estimates import stratified_bootstrap_interval, wilson_interval
from thorndike.statistics.profiles import performance_profile, sample_efficiency

GENERATOR = np.random.default_rng(0)
FIRST, SECOND = GENERATOR.normal(0.5, 1.0, size=(10, 3)), GENERATOR.gamma(2.0, 0.4, size=(8, 3))

DISTRIBUTIONS = {
    "normal": lambda generator, seeds: generator.normal(size=seeds),
    "skewed": lambda generator, seeds: generator.lognormal(size=seeds),
    "at most 500, often reached": lambda generator, seeds: np.minimum(500.0, generator.normal(495, 30, size=seeds)),
    "500, or a failure": lambda generator, seeds: np.where(generator.random(seeds) < 0.3, generator.normal(100, 50, seeds), 500.0),
}
QUICK = {"resamples": 500, "permutations": 1_000}


def false_verdicts(draw, seeds, others, pairs, **options):
    """How many of so many pairs of one and the same algorithm are called different."""
    generator = np.random.default_rng([seeds, others])
    return sum(
        compare_scores(draw(generator, seeds), draw(generator, others), **QUICK, **options).verdict != "cannot tell" for _ in range(pairs)
    )


@pytest.mark.parametrize("seeds", [5, 10, 20])
@pytest.mark.parametrize("draw", DISTRIBUTIONS.values(), ids=DISTRIBUTIONS)
def test_of_two_identical_algorithms_nobody_can_tell_in_95_of_100_trials(draw, seeds):
    assert false_verdicts(draw, seeds, seeds, pairs=100) <= 5


@pytest.mark.slow
@pytest.mark.parametrize("metric", ["iqm", "mean"])
@pytest.mark.parametrize("sizes", [(5, 5), (10, 10), (5, 20)])
@pytest.mark.parametrize("draw", DISTRIBUTIONS.values(), ids=DISTRIBUTIONS)
def test_a_false_verdict_comes_at_the_level_it_is_said_to(draw, sizes, metric):
    # 1.8 % of 500 and four standard errors.
    assert false_verdicts(draw, *sizes, pairs=500, metric=metric) <= 9 + 4 * math.sqrt(9)


@pytest.mark.slow
@pytest.mark.parametrize("draw", DISTRIBUTIONS.values(), ids=DISTRIBUTIONS)
def test_looking_again_after_more_seeds_keeps_false_verdicts_near_5_percent(draw):
    generator = np.random.default_rng(5)
    wrong = 0
    for _ in range(500):
        first, second = draw(generator, 20), draw(generator, 20)
        looks = (compare_scores(first[:seeds], second[:seeds], **QUICK).verdict for seeds in (5, 10, 15, 20))
        wrong += any(verdict != "cannot tell" for verdict in looks)
    assert wrong <= 25 + 3 * math.sqrt(25)


def test_a_clear_difference_is_told_with_five_seeds_and_never_with_fewer():
    high, low = [500.0, 499.0, 500.0, 498.0, 500.0], [301.0, 280.0, 310.0, 295.0, 320.0]
    assert compare_scores(high, low, **QUICK).verdict == "better"
    assert compare_scores(low, high, **QUICK).verdict == "worse"
    for few, many in ((4, 5), (5, 4), (1, 5), (1, 1)):
        told = compare_scores(high[:few], low[:many], **QUICK)
        assert told.verdict == "cannot tell"
        assert told.more_seeds == 5 - min(few, many)


def test_forty_seeds_cannot_make_up_for_four():
    told = compare_scores(np.linspace(490, 500, 40), [1.0, 2.0, 3.0, 4.0], **QUICK)
    assert (told.verdict, told.more_seeds) == ("cannot tell", 1)


@pytest.mark.parametrize("metric", ["iqm", "mean"])
def test_a_verdict_has_an_interval_without_zero_and_the_sign_of_the_difference(metric):
    generator = np.random.default_rng(6)
    told = [
        compare_scores(generator.normal(shift, 1, 8), generator.normal(0, 1, 8), metric=metric, **QUICK)
        for shift in np.arange(-3, 3.1, 0.3)
    ]
    assert {difference.verdict for difference in told} == {"better", "worse", "cannot tell"}
    for difference in told:
        low, high = difference.ci95
        if difference.verdict != "cannot tell":
            assert (difference.verdict == "better") == (low > 0)
            assert low > 0 or high < 0
            assert difference.more_seeds == 0


def test_failing_seeds_that_the_interquartile_mean_hides_are_seen_by_the_mean():
    steady, failing = np.full(20, 500.0), np.array([500.0] * 12 + [20.0] * 4 + [500.0] * 4)
    assert compare_scores(steady, failing, metric="iqm", **QUICK).difference == 0
    assert compare_scores(steady, failing, metric="mean", **QUICK).difference == 96


def test_several_comparisons_with_one_baseline_ask_for_more():
    high, low = [500.0, 499.0, 500.0, 498.0, 500.0], [301.0, 280.0, 310.0, 295.0, 320.0]
    assert compare_scores(high, low, comparisons=6, **QUICK).verdict == "better"
    assert compare_scores(high, low, comparisons=7, **QUICK).verdict == "cannot tell"


def test_no_number_of_seeds_tells_equal_scores_apart():
    told = compare_scores([500.0] * 10, [500.0] * 10, **QUICK)
    assert (told.verdict, told.difference, told.ci95, told.p_improvement.value, told.more_seeds) == ("cannot tell", 0, (0, 0), 0.5, None)


@pytest.mark.parametrize(("difference", "seeds"), [(2.0, 7), (1.5, 11), (1.0, 22)])
def test_with_the_seeds_that_are_said_to_be_needed_a_verdict_comes_in_four_of_five_trials(difference, seeds):
    assert math.ceil(seeds_needed(difference, 2.0)) == seeds
    generator = np.random.default_rng(seeds)
    trials = 250
    told = sum(
        compare_scores(generator.normal(difference, 1, seeds), generator.normal(0, 1, seeds), metric="mean", **QUICK).verdict == "better"
        for _ in range(trials)
    )
    assert 0.72 <= told / trials <= 0.90


@pytest.mark.parametrize(
    ("metric", "location"), [("iqm", lambda scores: np.sort(scores)[10:30].mean()), ("mean", np.mean)], ids=["iqm", "mean"]
)
def test_more_seeds_follows_from_the_spread_and_the_difference(metric, location):
    generator = np.random.default_rng(3)
    scores = generator.normal(size=40)
    told = compare_scores(scores + 0.3, scores, metric=metric, permutations=100)
    # One seed's share in the variance of 40 seeds, on each side; a resample's variance is 39/40 of that of new seeds.
    variance = 2 * 40 * np.var([location(generator.choice(scores, 40)) for _ in range(4_000)]) * 40 / 39
    assert told.verdict == "cannot tell"
    assert told.more_seeds + 40 == pytest.approx(seeds_needed(0.3, variance), rel=0.08)


def test_a_single_seed_has_no_interval():
    told, known = compare_scores([3.0], [1.0, 2.0]), standing([3.0], threshold=4.0)
    assert (told.difference, told.p_improvement.value) == (1.5, 1.0)
    assert np.isnan([*told.ci95, *told.p_improvement.ci95, *known.iqm.ci95, *known.mean.ci95, told.p_value]).all()
    assert known.failed.ci95[0] > 0


def test_standing_tells_what_the_two_means_hide():
    known = standing([500.0] * 8 + [100.0, 300.0], threshold=400.0)
    assert (known.seeds, known.iqm.value, known.mean.value, known.min) == (10, 500.0, 440.0, 100.0)
    assert known.failed == (0.2, wilson_interval(2, 10))
    assert known.mean.ci95 == stratified_bootstrap_interval([500.0] * 8 + [100.0, 300.0], lambda tables: tables.mean(axis=(1, 2)))
    assert standing([1.0, 2.0]).failed is None


def test_each_task_may_have_its_own_threshold():
    assert standing([[1.0, 10.0], [2.0, 30.0]], threshold=[1.5, 5.0], resamples=10).failed.value == 0.25


def test_probability_of_improvement_counts_pairs_and_half_of_the_ties():
    expected = np.mean([
        (x > y) + 0.5 * (x == y) for task in range(3) for x, y in itertools.product(FIRST[:, task].round(), SECOND[:, task].round())
    ])  # fmt: skip
    assert probability_of_improvement(FIRST.round(), SECOND.round()) == pytest.approx(expected, abs=1e-12)
    assert probability_of_improvement(FIRST, FIRST) == 0.5


def test_two_calls_give_the_same():
    assert compare_scores(FIRST, SECOND, **QUICK) == compare_scores(FIRST, SECOND, **QUICK)


def test_a_common_scale_puts_every_task_on_0_to_1_and_leaves_equal_scores_where_they_are():
    tables = [np.array([[0.0, 5.0], [10.0, 5.0]]), np.array([[20.0, 5.0]])]
    low, high = common_scale(tables)
    assert rescaled(tables[0], low, high).tolist() == [[0.0, 0.0], [0.5, 0.0]]
    assert rescaled(tables[1], low, high).tolist() == [[1.0, 0.0]]


@pytest.mark.parametrize(
    ("arguments", "options", "message"),
    [
        (([1.0], [1.0]), {"metric": "medain"}, "the metric is iqm or mean, not 'medain'"),
        (([1.0], [1.0]), {"metric": "means"}, "did you mean 'mean'"),
        ((np.ones((2, 2)), np.ones((2, 3))), {}, "on the same tasks, got 2 and 3"),
        (([1.0, math.nan], [1.0]), {}, "finite"),
        (([], [1.0]), {}, "at least one"),
    ],
)
def test_what_cannot_be_compared_is_a_mistake_in_one_line(arguments, options, message):
    with pytest.raises(UserError, match=message) as raised:
        compare_scores(*arguments, **options)
    assert "\n" not in str(raised.value)


# rliable (Agarwal et al. 2021) is used in these tests only.

REPS = 1_000


@pytest.fixture(scope="module")
def rliable():
    import rliable.library
    import rliable.metrics

    # It draws from NumPy's global generator.
    np.random.seed(0)
    return rliable


def within_monte_carlo_error(ours, theirs):
    """Ends of a 95 % interval from 1,000 resamples have a standard error of about 2.2 % of its width."""
    theirs = np.ravel(theirs)
    return ours == pytest.approx(tuple(theirs), abs=0.09 * (theirs[1] - theirs[0]))


def test_means_and_intervals_are_those_of_rliable(rliable):
    def both(scores):
        return np.array([rliable.metrics.aggregate_iqm(scores), rliable.metrics.aggregate_mean(scores)])

    points, intervals = rliable.library.get_interval_estimates({"first": FIRST, "second": SECOND}, both, reps=REPS)
    for name, scores in (("first", FIRST), ("second", SECOND)):
        known = standing(scores)
        assert (known.iqm.value, known.mean.value) == pytest.approx(tuple(points[name]), rel=0, abs=1e-12)
        assert within_monte_carlo_error(known.iqm.ci95, intervals[name][:, 0])
        assert within_monte_carlo_error(known.mean.ci95, intervals[name][:, 1])


def test_differences_and_their_intervals_are_those_of_rliable(rliable):
    def both(first, second):
        return np.array([metric(first) - metric(second) for metric in (rliable.metrics.aggregate_iqm, rliable.metrics.aggregate_mean)])

    points, intervals = rliable.library.get_interval_estimates({"pair": [FIRST, SECOND]}, both, reps=REPS)
    told = compare_scores(FIRST, SECOND, permutations=10)
    assert (told.iqm.value, told.mean.value) == pytest.approx(tuple(points["pair"]), rel=0, abs=1e-12)
    assert within_monte_carlo_error(told.iqm.ci95, intervals["pair"][:, 0])
    assert within_monte_carlo_error(told.mean.ci95, intervals["pair"][:, 1])


@pytest.mark.parametrize("digits", [9, 0], ids=["without ties", "with ties"])
def test_probability_of_improvement_is_that_of_rliable(rliable, digits):
    first, second = FIRST[:, :2].round(digits), SECOND[:, :2].round(digits)
    metric = rliable.metrics.probability_of_improvement
    points, intervals = rliable.library.get_interval_estimates({"pair": [first, second]}, metric, reps=250)
    told = compare_scores(first, second, permutations=10).p_improvement
    assert told.value == pytest.approx(float(points["pair"]), abs=1e-12)
    low, high = np.ravel(intervals["pair"])
    # A quarter of the resamples, for SciPy takes its time: twice the Monte-Carlo error.
    assert told.ci95 == pytest.approx((low, high), abs=0.18 * (high - low))


def test_profiles_are_those_of_rliable(rliable):
    thresholds = np.linspace(-1, 2, 7)
    values, bands = rliable.library.create_performance_profile({"first": FIRST}, thresholds, reps=REPS)
    band = performance_profile(FIRST, thresholds)
    assert band.value == pytest.approx(values["first"], abs=1e-12)
    # The share of 30 scores moves in steps of a 30th.
    assert np.abs(np.stack([band.low, band.high]) - bands["first"]).max() <= 1 / 30 + 1e-9


def test_sample_efficiency_is_that_of_rliable(rliable):
    curves = FIRST[:, :, None] * np.array([0.5, 1.0, 2.0]) + np.array([0.0, 1.0, 5.0])

    def iqm_at_each_point(scores):
        return np.array([rliable.metrics.aggregate_iqm(scores[..., point]) for point in range(3)])

    values, bands = rliable.library.get_interval_estimates({"first": curves}, iqm_at_each_point, reps=REPS)
    band = sample_efficiency(curves, resamples=20_000)
    assert band.value == pytest.approx(values["first"], abs=1e-12)
    for point in range(3):
        assert within_monte_carlo_error((band.low[point], band.high[point]), bands["first"][:, point])
