"""Curves with bands: performance profiles over several environments, and sample efficiency. NumPy only, deterministic."""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from thorndike.errors import UserError
from thorndike.statistics.estimates import Floats, finite_scores, pooled_iqm

RESAMPLES = 2_000
"""Fewer than for a single interval: a band has an interval at each of a hundred points, and is looked at, not read off."""


class Band(NamedTuple):
    """An estimate at each point, and its pointwise 95 % bootstrap interval: three arrays ``[points]``."""

    value: Floats
    low: Floats
    high: Floats


def performance_profile(scores: ArrayLike, thresholds: ArrayLike, *, resamples: int = RESAMPLES, seed: int = 0) -> Band:
    """The share of all scores ``[seeds, tasks]`` above each of ``thresholds [points]``, with its band.

    Scores of different tasks must be on one scale. Source: Agarwal et al. 2021, arXiv 2108.13264, section 4.2 (run-score distributions).
    Raises UserError for scores that are empty or not finite.
    """
    table = finite_scores(scores)
    table = table.reshape(len(table), -1)
    count, tasks = table.shape
    above = (table.T[:, :, None] > np.asarray(thresholds, np.float64)).astype(np.float64)
    # How often each seed is drawn is all that a share depends on.
    drawn = np.random.default_rng(seed).multinomial(count, np.full(count, 1 / count), size=(tasks, resamples)) / count
    low, high = np.quantile((drawn @ above).mean(axis=0), [0.025, 0.975], axis=0)
    return Band(above.mean(axis=(0, 1)), low, high)


def sample_efficiency(values: ArrayLike, *, resamples: int = RESAMPLES, seed: int = 0) -> Band:
    """The interquartile mean of ``values [seeds, tasks, points]`` at each point, with its band.

    A resample takes whole curves, each task's seeds on their own. Raises UserError for values that are empty or not finite: cut off the
    points at which not every seed has one.
    """
    table = finite_scores(values)
    if table.ndim != 3:
        raise UserError(f"expected values [seeds, tasks, points], got an array of shape {table.shape}")
    count, tasks, points = table.shape
    rows = np.random.default_rng(seed).integers(count, size=(resamples, count, tasks))
    middle, low, high = np.empty(points), np.empty(points), np.empty(points)
    for point in range(points):
        here = table[:, :, point]
        middle[point] = pooled_iqm(here[None])[0]
        low[point], high[point] = np.quantile(pooled_iqm(here[rows, np.arange(tasks)]), [0.025, 0.975])
    return Band(middle, low, high)
