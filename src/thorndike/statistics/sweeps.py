"""Which swept settings matter: response curves, effects and verdicts with their uncertainty. NumPy only, deterministic."""

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from thorndike.statistics.estimates import Floats, finite_scores

Verdict: TypeAlias = Literal["matters", "does not matter here", "cannot tell"]
Design: TypeAlias = Literal["grid", "random", "optuna"]
Groups: TypeAlias = NDArray[np.int64]
"""Of each trial ``[N]``, which value or bin of a setting it has: 0, 1, ..."""

RESAMPLES, PERMUTATIONS = 4_000, 4_000
SIGNIFICANT = 0.05
NEGLIGIBLE = 0.1
"""Share of the range of all scores below which an effect is none that anybody would tune for."""
FEWEST_COMPARISONS = 5
"""Seeds (times combinations of the other settings), or random trials, below which equal scores may be chance."""
_MOST_BINS, _TRIALS_OF_A_BIN = 6, 4
_CELLS_AT_ONCE = 2_000_000


class Factor(NamedTuple):
    """One swept setting, as the analysis sees it."""

    name: str
    values: tuple[object, ...]
    """Of each trial ``[N]``; numbers where it is a range."""
    is_range: bool


class Point(NamedTuple):
    """One point of a response curve."""

    values: tuple[object, ...]
    """The value, or of a bin of a range the lowest and the highest."""
    trials: int
    mean: float
    ci95: tuple[float, float]


class Effect(NamedTuple):
    """What a sweep says of one setting."""

    name: str
    verdict: Verdict
    effect: float
    """Largest minus smallest mean of the response curve."""
    ci95: tuple[float, float]
    p_value: float
    """Of "it has no effect", corrected for the number of settings (Holm 1979); NaN where no test is valid."""
    points: tuple[Point, ...]


def filled_scores(scores: Sequence[Sequence[float | None]]) -> Floats:
    """Scores ``[N, S]``; a seed that failed counts as the worst seen, 0 if all failed."""
    table = np.array([[np.nan if score is None else score for score in row] for row in scores], np.float64)
    known = table[np.isfinite(table)]
    return np.where(np.isfinite(table), table, known.min() if known.size else 0.0)


def best_trial(scores: Floats) -> int:
    """The trial with the highest mean over its seeds ``[N, S]``; of equal ones the first."""
    return int(np.argmax(scores.mean(axis=1)))


def effects_of(scores: Floats, factors: Sequence[Factor], design: Design, *, seed: int = 0) -> tuple[Effect, ...]:
    """A response curve and a verdict for each setting, from the scores ``[N, S]`` of N trials with S seeds each.

    *matters*: a permutation test says so. On a grid scores are exchanged between the values of a setting where all other settings and the
    seed's number are equal (if the setting had no effect, that would change nothing); of random trials whole trials are exchanged. Both
    are exact, whatever the distribution of scores. *does not matter here*: the upper end of the 95 % interval of its effect is below a
    tenth of the range of all scores. Otherwise, and where fewer than five seeds or trials can be compared, *cannot tell*. Trials that
    Optuna chose were chosen by their scores: no test is valid, and the verdict is always *cannot tell*. Raises ``UserError`` for scores
    that are empty or not finite.
    """
    table = finite_scores(scores)
    generator = np.random.default_rng(seed)
    groups = [_groups(factor) for factor in factors]
    whole_trials = None if design == "grid" and table.shape[1] > 1 else _trials_again(table, generator)
    p_values = [_p_value(table, index, groups, design, generator) for index in range(len(factors))]
    spread = float(table.max() - table.min())
    told = []
    for index, (factor, p_value) in enumerate(zip(factors, holm(p_values), strict=True)):
        means = (
            _within_rows_again(_cells(table, groups, index), generator) if whole_trials is None else _by_value(*whole_trials, groups[index])
        )
        points = _curve(table, factor, groups[index], means)
        low, high = _interval(np.nanmax(means, axis=1) - np.nanmin(means, axis=1))
        observed = [point.mean for point in points]
        effect = max(observed) - min(observed)
        comparisons = len(table) if whole_trials is not None else table.size // (groups[index].max() + 1)
        verdict = "cannot tell" if comparisons < FEWEST_COMPARISONS else _verdict(p_value, high, spread, design)
        told.append(Effect(factor.name, verdict, effect, (low, high), p_value, points))
    return tuple(told)


def holm(p_values: Sequence[float]) -> list[float]:
    """P-values corrected for their number, so that the chance of any false alarm stays what it was for one; NaN stays NaN.

    Source: Holm 1979, Scandinavian Journal of Statistics 6, 65-70.
    """
    known = [i for i in np.argsort(p_values) if not math.isnan(p_values[i])]
    corrected, largest = list(p_values), 0.0
    for rank, index in enumerate(known):
        largest = max(largest, min(1.0, (len(known) - rank) * p_values[index]))
        corrected[index] = largest
    return corrected


def _verdict(p_value: float, upper_end: float, spread: float, design: Design) -> Verdict:
    if design == "optuna":
        return "cannot tell"
    if p_value < SIGNIFICANT:
        return "matters"
    return "does not matter here" if upper_end <= NEGLIGIBLE * spread else "cannot tell"


def _groups(factor: Factor) -> Groups:
    """Values by number in the order in which they come, or bins of a range that hold equally many trials."""
    if not factor.is_range:
        distinct = list(dict.fromkeys(factor.values))
        return np.array([distinct.index(value) for value in factor.values])
    bins = int(np.clip(len(factor.values) // _TRIALS_OF_A_BIN, 2, _MOST_BINS))
    numbers = np.array(factor.values, np.float64)
    edges = np.quantile(numbers, np.linspace(0, 1, bins + 1)[1:-1])
    # Whole numbers repeat: bins that would be empty are left out.
    return np.unique(np.searchsorted(edges, numbers, side="right"), return_inverse=True)[1]


def _cells(table: Floats, groups: Sequence[Groups], index: int) -> Floats:
    """A grid's scores ``[blocks, values, S]``: in a block all settings but one are equal."""
    own = groups[index]
    others = np.stack([group for i, group in enumerate(groups) if i != index] or [np.zeros_like(own)], axis=1)
    block = np.unique(others, axis=0, return_inverse=True)[1].reshape(-1)
    cells = np.empty((block.max() + 1, own.max() + 1, table.shape[1]))
    cells[block, own] = table
    return cells


def _within_rows_again(cells: Floats, generator: np.random.Generator) -> Floats:
    """Bootstrap of a grid: the mean of each value ``[R, values]``, the seeds of each block drawn again.

    A seed is drawn with all its values, which began with the same random numbers: a setting that changes nothing then has an effect of
    exactly 0. Deviations are widened by ``sqrt(S / (S - 1))``: of S seeds they would be too small by that (Rao and Wu 1988, JASA 83); and
    by Student's quantile over the normal one, or too few intervals hold the truth (Hesterberg 2015, The American Statistician 69, 3.1).
    """
    blocks, _, seeds = cells.shape
    weights = generator.multinomial(seeds, np.full(seeds, 1 / seeds), size=(RESAMPLES, blocks)) / (seeds * blocks)
    drawn = np.einsum("rbs,bvs->rv", weights, cells)
    observed = cells.mean(axis=(0, 2))
    return observed + (drawn - observed) * math.sqrt(seeds / (seeds - 1)) * _student_over_normal(blocks * (seeds - 1))


def _student_over_normal(freedom: int) -> float:
    """How much wider a 95 % interval is by Student's t than by the normal distribution, from two ``freedom`` on within 4 %.

    Source: Abramowitz and Stegun 1964, 26.7.5.
    """
    z = 1.959964
    terms = ((z**3 + z) / 4, (5 * z**5 + 16 * z**3 + 3 * z) / 96, (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / 384)
    return 1 + sum(term / freedom ** (order + 1) for order, term in enumerate(terms)) / z


def _trials_again(table: Floats, generator: np.random.Generator) -> tuple[Floats, Groups]:
    """Bootstrap where trials are a sample, or have one seed: the means ``[R, N]`` of trials whose seeds were drawn again (widened as
    above), and how often each trial was drawn ``[R, N]``."""
    count, seeds = table.shape
    means = table.mean(axis=1)
    chunk = max(1, _CELLS_AT_ONCE // table.size)
    sizes = [min(chunk, RESAMPLES - start) for start in range(0, RESAMPLES, chunk)]
    drawn = np.concatenate(
        [(generator.multinomial(seeds, np.full(seeds, 1 / seeds), size=(size, count)) * table).sum(axis=-1) / seeds for size in sizes]
    )
    widened = means + (drawn - means) * (math.sqrt(seeds / (seeds - 1)) if seeds > 1 else 1.0)
    return widened, generator.multinomial(count, np.full(count, 1 / count), size=RESAMPLES)


def _by_value(means: Floats, counts: Groups, group: Groups) -> Floats:
    """The mean of each value in every resample ``[R, values]``, NaN where none of its trials was drawn."""
    member = _member(group)
    with np.errstate(invalid="ignore", divide="ignore"):
        return (means * counts) @ member / (counts @ member)


def _curve(table: Floats, factor: Factor, group: Groups, resampled: Floats) -> tuple[Point, ...]:
    """The response curve, numbers by size."""
    points = []
    for value in range(group.max() + 1):
        inside = np.flatnonzero(group == value)
        told = [factor.values[i] for i in inside]
        shown = (min(told), max(told)) if factor.is_range else (told[0],)  # type: ignore[type-var]
        points.append(Point(shown, len(inside), float(table[inside].mean()), _interval(resampled[:, value])))
    order = sorted(range(len(points)), key=lambda i: _rank(points[i].values[0], i))
    return tuple(points[i] for i in order)


def _member(group: Groups) -> Floats:
    """1 where a trial has a value ``[N, values]``."""
    return (group[:, None] == np.arange(group.max() + 1)).astype(np.float64)


def _rank(value: object, place: int) -> tuple[float, int]:
    """Numbers come by size, other values as they were given."""
    return (float(value), place) if isinstance(value, int | float) and not isinstance(value, bool) else (math.inf, place)


def _interval(values: Floats) -> tuple[float, float]:
    low, high = np.nanquantile(values, [0.025, 0.975])
    return float(low), float(high)


def _p_value(table: Floats, index: int, groups: Sequence[Groups], design: Design, generator: np.random.Generator) -> float:
    """P-value of "this setting has no effect on the mean", by permutation; NaN where trials were chosen by their scores."""
    if design == "optuna":
        return math.nan
    if design == "random":
        return _by_trials(table.mean(axis=1), groups[index], generator)
    return _within_blocks(_cells(table, groups, index), generator)


def _by_trials(means: Floats, group: Groups, generator: np.random.Generator) -> float:
    """Whole trials exchanged: is the spread of the values' means larger than chance makes it?"""
    orders = generator.permuted(np.tile(np.arange(len(means)), (PERMUTATIONS, 1)), axis=1)
    return _share_as_far(_between(means[orders], group), float(_between(means[None], group)[0]))


def _within_blocks(cells: Floats, generator: np.random.Generator) -> float:
    """A grid's scores ``[blocks, values, S]`` exchanged between the values of one setting, all others and the seed being equal."""
    # [blocks * seeds, values]: every row is one block, in which the order means nothing if the setting has no effect.
    rows = cells.transpose(0, 2, 1).reshape(-1, cells.shape[1])
    means = np.stack([generator.permuted(rows, axis=1).mean(axis=0) for _ in range(PERMUTATIONS)])
    return _share_as_far(means.var(axis=1), float(rows.mean(axis=0).var()))


def _between(means: Floats, group: Groups) -> Floats:
    """Spread between the values' means, each weighted by its trials: ``[R, N]`` -> ``[R]``."""
    member = _member(group)
    size = member.sum(axis=0)
    return (((means @ member) / size - means.mean(axis=1, keepdims=True)) ** 2 @ size) / len(group)


def _share_as_far(tried: Floats, observed: float) -> float:
    # What is equal but for rounding counts as equally far.
    return float((1 + (tried >= observed * (1 - 1e-9) - 1e-12).sum()) / (1 + len(tried)))
