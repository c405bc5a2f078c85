"""How far raters agree, with each other, with what is known, and with themselves.

Tables are ``[raters, units]``, NaN where a rater was not asked. Sources: Cohen 1960, Educational and Psychological Measurement 20;
Fleiss 1971, Psychological Bulletin 76; Krippendorff 2011, Computing Krippendorff's Alpha-Reliability.
"""

from collections import defaultdict
from collections.abc import Sequence
from itertools import combinations
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from thorndike.language.preferences.comparisons import Comparisons, Floats, as_table, compared, value_of
from thorndike.language.preferences.judgements import Judged
from thorndike.statistics.estimates import wilson_interval

_RESAMPLES = 2_000


class Share(NamedTuple):
    """Of how many something is true."""

    hits: int
    of: int

    @property
    def value(self) -> float | None:
        """The share, None of nothing."""
        return self.hits / self.of if self.of else None

    @property
    def ci95(self) -> tuple[float, float] | None:
        """Wilson's interval."""
        return wilson_interval(self.hits, self.of) if self.of else None


class RaterReport(NamedTuple):
    """What is known of a rater."""

    rater: str
    judgements: int
    skipped: int
    with_others: Share
    """Pairs on which the rater said what another one said."""
    gold: Share
    """Gold questions that were answered right."""
    consistency: Share
    """Of repeated questions, those answered as before."""
    left: Share
    """Of decided pairs, those won by what was shown first: about a half, or the rater looks at one side."""
    cycles: Share
    """Of triples of candidates, those judged A > B > C > A."""
    median_seconds: float | None


class Agreement(NamedTuple):
    """What is known of all raters together. None where nobody judged what another one did."""

    pairs: int
    shared_pairs: int
    raw: float | None
    """The chance that two raters of the same pair say the same."""
    raw_ci95: tuple[float, float] | None
    """By bootstrap over pairs."""
    cohen_kappa: float | None
    """The mean over all pairs of raters, each weighted by what both judged."""
    fleiss_kappa: float | None
    """Over the pairs that have the commonest number of raters, if that is at least two."""
    alpha_nominal: float | None
    alpha_ordinal: float | None
    """Of how much better the first is: from "much worse" over a tie to "much better"."""
    raters: tuple[RaterReport, ...]


def agreement(judged: Sequence[Judged]) -> Agreement:
    """Everything at once."""
    comparisons = compared(judged)
    table = as_table(comparisons)
    scale = as_table(comparisons, np.sign(comparisons.value - 0.5) * comparisons.strength)
    agreed, possible = agreeing_pairs(table)
    known = possible > 0
    raters = tuple(_report(name, judged, table, comparisons) for name in sorted({each.rater for each in judged}))
    return Agreement(
        pairs=len(comparisons.pairs),
        shared_pairs=int(known.sum()),
        raw=float((agreed[known] / possible[known]).mean()) if known.any() else None,
        raw_ci95=_bootstrap_mean(agreed[known] / possible[known]) if known.any() else None,
        cohen_kappa=mean_cohen_kappa(table),
        fleiss_kappa=_fleiss_of_table(table),
        alpha_nominal=krippendorff_alpha(table, "nominal"),
        alpha_ordinal=krippendorff_alpha(scale, "ordinal"),
        raters=raters,
    )


def agreeing_pairs(table: Floats) -> tuple[Floats, Floats]:
    """Of each unit: how many pairs of raters say the same, and how many pairs there are."""
    agreed = np.zeros(table.shape[1])
    for value in np.unique(table[~np.isnan(table)]):
        count = (table == value).sum(axis=0)
        agreed += count * (count - 1) / 2
    asked = (~np.isnan(table)).sum(axis=0)
    return agreed, asked * (asked - 1) / 2


def cohen_kappa(first: ArrayLike, second: ArrayLike) -> float | None:
    """Agreement of two raters beyond chance, of what both judged (``[units]``, NaN elsewhere). None where chance alone explains all."""
    one, two = np.asarray(first, np.float64), np.asarray(second, np.float64)
    both = ~np.isnan(one) & ~np.isnan(two)
    one, two = one[both], two[both]
    if not len(one):
        return None
    chance = sum(float((one == value).mean() * (two == value).mean()) for value in np.unique(np.concatenate([one, two])))
    return None if chance == 1 else (float((one == two).mean()) - chance) / (1 - chance)


def mean_cohen_kappa(table: Floats) -> float | None:
    """Cohen's kappa of every two raters who share units, weighted by how many they share."""
    total, weight = 0.0, 0
    for one, two in combinations(table, 2):
        kappa, shared = cohen_kappa(one, two), int((~np.isnan(one) & ~np.isnan(two)).sum())
        if kappa is not None:
            total, weight = total + kappa * shared, weight + shared
    return total / weight if weight else None


def fleiss_kappa(counts: ArrayLike) -> float | None:
    """Agreement beyond chance of a fixed number of raters; ``counts [units, categories]``: how many chose each."""
    table = np.asarray(counts, np.float64)
    raters = float(table[0].sum()) if len(table) else 0.0
    if raters < 2:
        return None
    observed = ((table**2).sum(axis=1) - raters) / (raters * (raters - 1))
    chance = float(((table.sum(axis=0) / table.sum()) ** 2).sum())
    return None if chance == 1 else (float(observed.mean()) - chance) / (1 - chance)


def _fleiss_of_table(table: Floats) -> float | None:
    values = np.unique(table[~np.isnan(table)])
    counts = np.stack([(table == value).sum(axis=0) for value in values], axis=1) if len(values) else np.zeros((0, 0))
    asked = counts.sum(axis=1)
    numbers, how_often = np.unique(asked[asked >= 2], return_counts=True)
    return fleiss_kappa(counts[asked == numbers[how_often.argmax()]]) if len(numbers) else None


def krippendorff_alpha(table: ArrayLike, level: Literal["nominal", "ordinal"]) -> float | None:
    """Krippendorff's alpha of any number of raters, with gaps; None where no unit has two, or all say the same."""
    data = np.asarray(table, np.float64)
    values = np.unique(data[~np.isnan(data)])
    counts = np.stack([(data == value).sum(axis=0) for value in values], axis=1) if len(values) else np.zeros((0, 0))
    counts = counts[counts.sum(axis=1) >= 2].astype(np.float64)
    if not len(counts):
        return None
    sizes = counts.sum(axis=1, keepdims=True)
    coincidences = (counts / (sizes - 1)).T @ counts - np.diag((counts / (sizes - 1)).sum(axis=0))
    frequencies = coincidences.sum(axis=1)
    total = frequencies.sum()
    distances = _distances(frequencies, level)
    expected = float(frequencies @ distances @ frequencies) / (total - 1)
    return None if expected == 0 else 1 - float((coincidences * distances).sum()) / expected


def _distances(frequencies: Floats, level: str) -> Floats:
    """Squared differences ``[values, values]``; ordinal ones count how many lie between."""
    count = len(frequencies)
    if level == "nominal":
        return 1 - np.eye(count)
    middles = np.cumsum(frequencies) - frequencies / 2
    return (middles[:, None] - middles[None, :]) ** 2


def _bootstrap_mean(values: Floats, seed: int = 0) -> tuple[float, float]:
    generator = np.random.default_rng(seed)
    # A few values occur often (0, 1/3, 1): how often each is drawn says all, however many pairs there are.
    distinct, counts = np.unique(values, return_counts=True)
    drawn = generator.multinomial(len(values), counts / len(values), size=_RESAMPLES) @ distinct / len(values)
    low, high = np.quantile(drawn, (0.025, 0.975))
    return float(low), float(high)


def _report(name: str, judged: Sequence[Judged], table: Floats, comparisons: Comparisons) -> RaterReport:
    own = [each for each in judged if each.rater == name]
    with_others = Share(0, 0)
    if name in comparisons.raters:
        number = comparisons.raters.index(name)
        same = np.delete(table, number, axis=0) == table[number]
        both = ~np.isnan(np.delete(table, number, axis=0)) & ~np.isnan(table[number])
        with_others = Share(int(same.sum()), int(both.sum()))
    asked_gold = [each for each in own if each.best is not None and each.ranks is not None]
    right = sum(each.ranks[each.best] == 0 and each.ranks.count(0) == 1 for each in asked_gold if each.ranks and each.best is not None)
    times = [each.milliseconds / 1000 for each in own if each.milliseconds is not None]
    return RaterReport(
        rater=name,
        judgements=len(own),
        skipped=sum(each.ranks is None for each in own),
        with_others=with_others,
        gold=Share(right, len(asked_gold)),
        consistency=_consistency(own),
        left=_left(own),
        cycles=_cycles(own),
        median_seconds=float(np.median(times)) if times else None,
    )


def _consistency(own: Sequence[Judged]) -> Share:
    before = {each.item: each.ranks for each in own if not each.repeated and each.ranks is not None}
    again = [each for each in own if each.repeated and each.ranks is not None and each.item in before]
    return Share(sum(each.ranks == before[each.item] for each in again), len(again))


def _left(own: Sequence[Judged]) -> Share:
    decided = [each for each in own if each.verdict in ("a", "b")]
    return Share(sum(each.verdict == "a" for each in decided), len(decided))


def _cycles(own: Sequence[Judged]) -> Share:
    """Triples of candidates of one prompt whose three pairs were all decided: pairs of a prompt may be asked one by one."""
    better: dict[int, set[tuple[int, int]]] = defaultdict(set)
    for each in own:
        if each.ranks is None or each.repeated:
            continue
        for i, j in combinations(range(len(each.ranks)), 2):
            value = value_of(each.ranks, i, j)
            if value != 0.5:
                first, second = each.candidates[i], each.candidates[j]
                better[each.prompt].add((first, second) if value == 1 else (second, first))
    triples = cycles = 0
    for wins in better.values():
        for one, two, three in combinations(sorted({each for pair in wins for each in pair}), 3):
            edges = [(one, two), (two, three), (three, one)]
            if all(edge in wins or edge[::-1] in wins for edge in edges):
                triples += 1
                cycles += len({edge in wins for edge in edges}) == 1
    return Share(cycles, triples)
