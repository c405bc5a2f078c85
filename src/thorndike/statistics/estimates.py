"""Estimates over seeds, with their uncertainty: NumPy only, deterministic."""

import math
from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thorndike.errors import UserError

Floats: TypeAlias = NDArray[np.float64]
Statistic: TypeAlias = Callable[[Floats], Floats]
"""``[..., runs, tasks]`` -> ``[...]``: one number for each table of scores."""

RESAMPLES = 50_000
_CELLS_AT_ONCE = 4_000_000  # 32 MB of scores: large enough to be fast, small enough for any machine


class Summary(NamedTuple):
    """What is reported of one policy trained with several seeds."""

    mean: float
    iqm: float
    min: float
    """The worst seed's mean return: what an interquartile mean hides."""
    max: float
    ci95: tuple[float, float]
    """95 % interval of the mean, by bootstrap over seeds; with a single seed over its episodes."""
    iqm_ci95: tuple[float, float]
    """The same for the interquartile mean."""
    per_seed: tuple[float, ...]


def interquartile_mean(scores: ArrayLike) -> float:
    """Mean of the middle half of all scores: ``floor(n / 4)`` of them are cut off at each end.

    Any shape: runs and tasks are pooled, as in rliable (``scipy.stats.trim_mean(scores, 0.25, axis=None)``).
    Source: Agarwal et al. 2021, Deep RL at the Edge of the Statistical Precipice, arXiv 2108.13264.
    """
    return float(pooled_iqm(finite_scores(scores).reshape(1, -1, 1))[0])


def stratified_bootstrap_interval(
    scores: ArrayLike,
    statistic: Statistic | None = None,
    *,
    resamples: int = RESAMPLES,
    confidence: float = 0.95,
    seed: int = 0,
) -> tuple[float, float]:
    """Percentile bootstrap interval of a statistic of ``scores [runs]`` or ``[runs, tasks]``; the interquartile mean by default.

    Stratified: every task's runs are drawn again on their own. The same seed gives the same interval.
    Below about ten runs such intervals are too narrow (Agarwal et al. 2021, A.5). Raises UserError for scores that are empty or not finite.
    """
    return percentile_interval(bootstrap_values(scores, pooled_iqm if statistic is None else statistic, resamples, seed), confidence)


def bootstrap_values(scores: ArrayLike, statistic: Statistic, resamples: int = RESAMPLES, seed: int = 0) -> Floats:
    """The statistic of each of ``resamples`` stratified resamples of ``scores [runs]`` or ``[runs, tasks]``.

    Raises UserError for scores that are empty or not finite.
    """
    table = finite_scores(scores)
    table = table.reshape(len(table), -1)
    generator = np.random.default_rng(seed)
    chunk = max(1, _CELLS_AT_ONCE // table.size)
    values: list[Floats] = []
    for start in range(0, resamples, chunk):
        rows = generator.integers(len(table), size=(min(chunk, resamples - start), *table.shape))
        values.append(statistic(table[rows, np.arange(table.shape[1])]))
    return np.concatenate(values)


def wilson_interval(successes: float, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Wilson's score interval of a success rate: right for few trials and for rates near 0 and 1. Half successes may count too (draws).

    Raises UserError unless ``0 <= successes <= trials`` and ``trials >= 1``. Source: Wilson 1927, JASA 22, 209-212.
    """
    if trials < 1 or not 0 <= successes <= trials:
        raise UserError(f"a success rate needs 0 <= successes <= trials and at least one trial, got {successes} of {trials}")
    z = _normal_quantile(0.5 + confidence / 2)
    rate, spread = successes / trials, z * z / trials
    centre = (rate + spread / 2) / (1 + spread)
    half = math.sqrt(rate * (1 - rate) * spread + spread * spread / 4) / (1 + spread)
    low = 0.0 if successes == 0 else centre - half
    high = 1.0 if successes == trials else centre + half
    return low, high


def summary(scores: ArrayLike, *, resamples: int = RESAMPLES, seed: int = 0) -> Summary:
    """Mean, interquartile mean, worst seed and interval of ``scores [seeds]`` (one number a seed) or ``[seeds, episodes]``.

    A seed counts once, by the mean of its episodes: episodes of one policy say nothing about the next training run.
    Raises UserError for scores that are empty or not finite.
    """
    table = finite_scores(scores)
    table = table.reshape(len(table), -1)
    seeds = table.mean(axis=1)
    sample = table[0] if len(seeds) == 1 else seeds
    mean_interval = stratified_bootstrap_interval(sample, plain_mean, resamples=resamples, seed=seed)
    iqm_interval = stratified_bootstrap_interval(sample, resamples=resamples, seed=seed)
    per_seed = tuple(map(float, seeds))
    return Summary(float(seeds.mean()), interquartile_mean(seeds), min(per_seed), max(per_seed), mean_interval, iqm_interval, per_seed)


def mean_interval_over_seeds(values: ArrayLike, *, resamples: int = 2_000, seed: int = 0) -> tuple[Floats, Floats, Floats]:
    """Mean and 95 % bootstrap interval at each point of curves ``[points, seeds]``: three arrays ``[points]``.

    NaN marks a seed that has nothing to say at a point yet; a point where no seed has gives NaN. A resample takes whole seeds, so that
    neighbouring points stay together.
    """
    table = np.asarray(values, np.float64)
    count = table.shape[1]
    generator = np.random.default_rng(seed)
    weights = generator.multinomial(count, np.full(count, 1 / count), size=resamples).astype(np.float64)
    known = np.isfinite(table)
    filled = np.where(known, table, 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = filled.sum(1) / known.sum(1)
        resampled = (filled @ weights.T) / (known @ weights.T)
    resampled = np.where(np.isnan(resampled), mean[:, None], resampled)
    low, high = np.quantile(resampled, [0.025, 0.975], axis=1)
    return mean, low, high


def pooled_iqm(tables: Floats) -> Floats:
    """The interquartile mean of each table ``[tables, runs, tasks]``, runs and tasks pooled."""
    ordered = np.sort(tables.reshape(len(tables), -1), axis=1)
    cut = ordered.shape[1] // 4
    return ordered[:, cut : ordered.shape[1] - cut].mean(axis=1)


def plain_mean(tables: Floats) -> Floats:
    """The mean of each table ``[tables, runs, tasks]``."""
    return tables.reshape(len(tables), -1).mean(axis=1)


def percentile_interval(values: Floats, confidence: float = 0.95) -> tuple[float, float]:
    """The two quantiles that hold the middle ``confidence`` of values."""
    low, high = np.quantile(values, [(1 - confidence) / 2, (1 + confidence) / 2])
    return float(low), float(high)


def finite_scores(scores: ArrayLike) -> Floats:
    """Scores as an array. Raises UserError if there are none, or some are not finite."""
    table = np.asarray(scores, np.float64)
    if table.size == 0 or not np.isfinite(table).all():
        raise UserError(f"expected finite scores, at least one, got {table.size} of which {int(np.isfinite(table).sum())} are finite")
    return table


def _normal_quantile(probability: float) -> float:
    """The standard normal quantile by bisection of erfc: importing SciPy for it would cost more than all of this file."""
    low, high = -40.0, 40.0
    for _ in range(100):
        middle = (low + high) / 2
        if 0.5 * math.erfc(-middle / math.sqrt(2)) < probability:
            low = middle
        else:
            high = middle
    return (low + high) / 2
