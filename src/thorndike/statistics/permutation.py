"""Could two sets of scores have come from the same algorithm? A studentised permutation test: NumPy only, deterministic."""

import itertools
import math
from collections.abc import Iterator

import numpy as np

from thorndike.statistics.estimates import Floats, Statistic

PERMUTATIONS = 20_000
"""Splits that are tried: all there are, if there are no more than these (8 seeds against 8), else this many at random."""
_CELLS_AT_ONCE = 2_000_000
_SAME = 1e-12  # relative: differences below it are rounding


def permutation_p_value(scores: Floats, others: Floats, statistic: Statistic, *, permutations: int = PERMUTATIONS, seed: int = 0) -> float:
    """Two-sided p-value of "one algorithm made both": ``scores [n, tasks]``, ``others [m, tasks]``; NaN with a single seed on a side.

    Splitting the seeds of each task anew into n and m leaves everything as it was if the algorithms are the same. So a share of p or less
    of splits at least as far apart as the observed one comes with probability p or less, whatever the distribution of scores and however
    few the seeds. "Far apart" is measured by the difference of ``statistic``, divided by its standard error as Welch would estimate it: a
    difference of spreads alone is not taken for one of levels (Janssen 1997, Statistics & Probability Letters 36, 9-21; Chung and Romano
    2013, arXiv 1304.5939). The standard error is that of the means even for the interquartile mean: the trimmed one of five seeds would
    rest on three values, and five times 500 would never be told from five seeds around 400.
    """
    count = len(scores)
    if min(count, len(others)) < 2:
        return math.nan
    pooled = np.concatenate([scores, others])
    scale = float(np.abs(pooled).max())
    observed = _distance(scores[None], others[None], statistic, scale)[0]
    exhaustive = _can_try_all(count, len(others), scores.shape[1], permutations)
    splits = _all_splits(count, len(pooled)) if exhaustive else _random_splits(pooled.shape, permutations, np.random.default_rng(seed))
    tried = as_far = 0
    for order in splits:
        tables = np.take_along_axis(pooled[None], order, axis=1)
        distances = _distance(tables[:, :count], tables[:, count:], statistic, scale)
        # Splits that are equal but for rounding count as equally far.
        as_far += int((distances >= observed * (1 - 1e-9)).sum())
        tried += len(order)
    return as_far / tried if exhaustive else (as_far + 1) / (tried + 1)


def _distance(first: Floats, second: Floats, statistic: Statistic, scale: float) -> Floats:
    """``[splits, n, tasks]`` and ``[splits, m, tasks]`` -> ``[splits]``: absolute difference of the statistic over its standard error."""
    difference = np.abs(statistic(first) - statistic(second))
    variance = (first.var(axis=1, ddof=1) / first.shape[1] + second.var(axis=1, ddof=1) / second.shape[1]).sum(-1) / first.shape[2] ** 2
    difference = np.where(difference <= _SAME * scale, 0.0, difference)
    error = np.where(variance <= (_SAME * scale) ** 2, 0.0, np.sqrt(variance))
    # Without any spread a difference is infinitely far, and none is none.
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(difference == 0, 0.0, difference / error)


def _can_try_all(count: int, other_count: int, tasks: int, permutations: int) -> bool:
    return tasks == 1 and math.comb(count + other_count, count) <= permutations


def _all_splits(count: int, total: int) -> Iterator[np.ndarray]:
    """Every way to choose ``count`` of ``total``, the chosen ones first: one array ``[splits, total, 1]``."""
    chosen = np.array(list(itertools.combinations(range(total), count)))
    left = np.ones((len(chosen), total), bool)
    np.put_along_axis(left, chosen, False, axis=1)
    yield np.concatenate([chosen, np.nonzero(left)[1].reshape(len(chosen), -1)], axis=1)[..., None]


def _random_splits(shape: tuple[int, ...], permutations: int, generator: np.random.Generator) -> Iterator[np.ndarray]:
    """Orders ``[splits, total, tasks]``, each task's its own, a chunk at a time."""
    chunk = max(1, _CELLS_AT_ONCE // math.prod(shape))
    for start in range(0, permutations, chunk):
        yield generator.random((min(chunk, permutations - start), *shape)).argsort(axis=1)
