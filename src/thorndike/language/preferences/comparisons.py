"""Judgements as arrays: what each rater said of each pair of candidates."""

from collections.abc import Iterable, Sequence
from itertools import combinations
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from thorndike.language.preferences.judgements import Judged

Floats: TypeAlias = NDArray[np.float64]
Ints: TypeAlias = NDArray[np.int64]


class Pair(NamedTuple):
    """Two candidates of an item, by number; the one that stands first in the item is the first here, too."""

    item: int
    prompt: int
    first: int
    second: int


class Comparisons(NamedTuple):
    """``n`` answers to the question whether the first of a pair is better."""

    pairs: tuple[Pair, ...]
    raters: tuple[str, ...]
    pair: Ints
    """``[n]``: which of ``pairs``."""
    rater: Ints
    """``[n]``: which of ``raters``."""
    value: Floats
    """``[n]``: 1 the first is better, 0 the second, 0.5 a tie."""
    strength: Floats
    """``[n]``: 1 slightly, 2 clearly, 3 much; 1 where nobody asked."""


def compared(judged: Iterable[Judged]) -> Comparisons:
    """Every pair of candidates in every judgement: a ranking of K gives K (K - 1) / 2. Skips and repetitions are left out."""
    pairs: dict[Pair, int] = {}
    raters: dict[str, int] = {}
    rows = []
    for each in judged:
        if each.ranks is None or each.repeated:
            continue
        rater = raters.setdefault(each.rater, len(raters))
        for i, j in combinations(range(len(each.ranks)), 2):
            pair = pairs.setdefault(Pair(each.item, each.prompt, each.candidates[i], each.candidates[j]), len(pairs))
            rows.append((pair, rater, value_of(each.ranks, i, j), each.strength or 1))
    table = np.array(rows, np.float64).reshape(-1, 4)
    return Comparisons(tuple(pairs), tuple(raters), table[:, 0].astype(np.int64), table[:, 1].astype(np.int64), table[:, 2], table[:, 3])


def value_of(ranks: Sequence[int], i: int, j: int) -> float:
    """1 where position i is ranked above j, 0 below, 0.5 level."""
    return 0.5 + 0.5 * float(np.sign(ranks[j] - ranks[i]))


def as_table(comparisons: Comparisons, values: Floats | None = None) -> Floats:
    """``[raters, pairs]``: the values, NaN where a rater was not asked."""
    table = np.full((len(comparisons.raters), len(comparisons.pairs)), np.nan)
    table[comparisons.rater, comparisons.pair] = comparisons.value if values is None else values
    return table
