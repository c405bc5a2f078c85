"""A crowd that judges pairs whose truth is known, without a store: thousands of labels in a moment."""

import random

import numpy as np

from thorndike.language.preferences.comparisons import Comparisons, Pair
from thorndike.language.preferences.raters import choose, crowd


def crowd_labels(seed, pairs=2_000, labels=3, raters=None):
    """Comparisons of pairs by a random few of the crowd each, and whether the first of each pair is better."""
    generator, draws = np.random.default_rng(seed), random.Random(seed)
    raters = crowd() if raters is None else raters
    utilities = generator.normal(size=(pairs, 2))
    rows = []
    for pair, (first, second) in enumerate(utilities.tolist()):
        for rater in generator.choice(len(raters), labels, replace=False).tolist():
            swapped = draws.random() < 0.5
            said, _ = choose(raters[rater], (second, first) if swapped else (first, second), draws)
            value = {"a": 1.0, "b": 0.0, "tie": 0.5}[said]
            rows.append((pair, rater, 1 - value if swapped else value))
    table = np.array(rows)
    names = tuple(each.name for each in raters)
    numbered = tuple(Pair(each, each, 2 * each, 2 * each + 1) for each in range(pairs))
    whole = table[:, :2].astype(np.int64)
    return Comparisons(numbered, names, whole[:, 0], whole[:, 1], table[:, 2], np.ones(len(table))), utilities[:, 0] > utilities[:, 1]


def accuracy(first_is_better, truth):
    """Of labels; a half for each that says nothing."""
    return float(np.where(first_is_better == 0.5, 0.5, (first_is_better > 0.5) == truth).mean())
