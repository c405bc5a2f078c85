"""Labels of a crowd in which some guess and one has it the wrong way round: what each way of aggregating makes of them."""

import numpy as np
import pytest

from thorndike.errors import UserError
from thorndike.language.preferences.comparisons import Comparisons, Pair
from thorndike.language.preferences.noise import believe, davidson, dawid_skene, majority, mean_labels
from thorndike.language.preferences.raters import Rater, crowd, crowd_comparisons


def crowd_labels(seed, pairs=2_000, labels=3, raters=None):
    """Comparisons of pairs by a random few of the crowd each, and whether the first of each pair is better."""
    utilities = np.random.default_rng(seed).normal(size=(pairs, 2))
    return crowd_comparisons(utilities, crowd() if raters is None else raters, labels, seed), utilities[:, 0] > utilities[:, 1]


def accuracy(first_is_better, truth):
    """Of labels; a half for each that says nothing."""
    return float(np.where(first_is_better == 0.5, 0.5, (first_is_better > 0.5) == truth).mean())


def single_labels(comparisons):
    """The first label of every pair."""
    return comparisons.value[np.unique(comparisons.pair, return_index=True)[1]]


@pytest.mark.parametrize("seed", range(3))
def test_a_single_label_is_worse_than_the_majority_which_is_worse_than_dawid_skene(seed):
    comparisons, truth = crowd_labels(seed, pairs=6_600)
    single = accuracy(single_labels(comparisons), truth)
    most = accuracy(majority(comparisons).first_is_better, truth)
    belief = dawid_skene(comparisons).belief
    found = accuracy(belief.first_is_better, truth)
    assert 0.65 < single < 0.72 and single + 0.04 < most and most + 0.05 <= found and found >= 0.81
    trusted = dict(zip(comparisons.raters, belief.reliability, strict=True))
    assert trusted["inverted-1"] < 0.35
    assert all(0.4 < each < 0.6 for name, each in trusted.items() if name.startswith("guessing"))
    assert all(each > 0.75 for name, each in trusted.items() if name.startswith("fair"))


def test_the_posterior_is_calibrated():
    comparisons, truth = crowd_labels(7, pairs=6_600)
    first = dawid_skene(comparisons).belief.first_is_better
    for low, high in [(0.0, 0.25), (0.25, 0.5), (0.5, 0.75), (0.75, 1.0)]:
        chosen = (first >= low) & (first < high)
        assert chosen.sum() > 100 and abs(first[chosen].mean() - truth[chosen].mean()) < 0.06


def test_dawid_skene_equals_a_slow_loop():
    comparisons, _ = crowd_labels(1, pairs=40)
    found = dawid_skene(comparisons)
    votes = list(zip(comparisons.pair.tolist(), comparisons.rater.tolist(), comparisons.value.tolist(), strict=True))
    first = [np.mean([v for p, _, v in votes if p == pair]) for pair in range(40)]
    for _ in range(600):
        trusted = []
        for rater in range(len(comparisons.raters)):
            own = [(p, v) for p, r, v in votes if r == rater]
            agreed = sum(v * first[p] + (1 - v) * (1 - first[p]) for p, v in own)
            trusted.append((agreed + 3) / (len(own) + 4))
        share = (sum(first) + 1) / 42
        for pair in range(40):
            yes, no = share, 1 - share
            for p, r, v in votes:
                if p == pair:
                    yes *= trusted[r] if v == 1 else 1 - trusted[r]
                    no *= trusted[r] if v == 0 else 1 - trusted[r]
            first[pair] = yes / (yes + no)
    np.testing.assert_allclose(found.belief.first_is_better, first, atol=1e-6)
    np.testing.assert_allclose(found.belief.reliability, trusted, atol=1e-6)


def test_one_vote_of_one_rater_is_believed_a_little():
    one = Comparisons((Pair(1, 1, 1, 2),), ("anna",), np.array([0]), np.array([0]), np.array([1.0]), np.ones(1))
    assert 0.6 < dawid_skene(one).belief.first_is_better[0] < 0.99
    tie = one._replace(value=np.array([0.5]))
    assert dawid_skene(tie).belief.first_is_better[0] == mean_labels(tie).first_is_better[0] == majority(tie).first_is_better[0] == 0.5


def test_nothing_is_no_label():
    empty = Comparisons((), (), *(np.zeros(0, np.int64),) * 2, np.zeros(0), np.zeros(0))
    for method in ("mean", "majority", "dawid_skene"):
        assert believe(empty, method).first_is_better.shape == (0,)


def test_an_unknown_method_and_a_prior_that_means_ill_are_refused():
    comparisons, _ = crowd_labels(1, pairs=4)
    with pytest.raises(UserError, match="mean, majority"):
        believe(comparisons, "best")
    with pytest.raises(UserError, match="first one greater"):
        dawid_skene(comparisons, (1.0, 2.0))


def test_davidson_finds_strengths_and_ties():
    generator = np.random.default_rng(0)
    strengths, nu, games = np.array([-1.0, 0.0, 0.3, 0.7]), 0.8, 10_000
    p = np.exp(strengths)
    pairs = [(i, j) for i in range(4) for j in range(i + 1, 4)]
    which = generator.integers(len(pairs), size=games)
    first, second = np.array(pairs)[which].T
    tie = nu * np.sqrt(p[first] * p[second])
    total = p[first] + p[second] + tie
    u = generator.random(games)
    value = np.where(u < p[first] / total, 1.0, np.where(u < (p[first] + tie) / total, 0.5, 0.0))
    numbered = tuple(Pair(each, 0, *pair) for each, pair in enumerate(pairs))
    found = davidson(Comparisons(numbered, ("anna",), which, np.zeros(games, np.int64), value, np.ones(games)))
    np.testing.assert_allclose([found.strengths[each] for each in range(4)], strengths, atol=0.1)
    assert abs(found.tie - nu) < 0.1


def test_one_that_never_lost_is_not_infinitely_strong():
    won = Comparisons((Pair(1, 1, 1, 2),), ("anna",), np.zeros(9, np.int64), np.zeros(9, np.int64), np.ones(9), np.ones(9))
    found = davidson(won)
    assert 1 < found.strengths[1] - found.strengths[2] < 20 and found.tie == 0


def test_ties_and_sides_of_a_rater():
    looks_left = [Rater("left", lapse=0.0, side_bias=3.0, ties=0.0)]
    comparisons, truth = crowd_labels(3, labels=1, raters=looks_left)
    assert accuracy(comparisons.value, truth) < 0.7
    ties, _ = crowd_labels(3, labels=1, raters=[Rater("careful", lapse=0.0, ties=0.5)])
    assert 0.2 < (ties.value == 0.5).mean() < 0.35
