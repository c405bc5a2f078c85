"""What to believe when raters disagree: the chance that the first of each pair is better, and how far each rater can be trusted.

A tie counts as half a vote for either side, except in ``davidson``, which says how likely ties are.
"""

from typing import Literal, NamedTuple, TypeAlias, get_args

import numpy as np

from thorndike.errors import UserError
from thorndike.language.preferences.comparisons import Comparisons, Floats

_ITERATIONS = 500
_TOLERANCE = 1e-9
Method: TypeAlias = Literal["mean", "majority", "dawid_skene"]
METHODS = get_args(Method)


class Belief(NamedTuple):
    """What is believed of every pair, and of every rater."""

    first_is_better: Floats
    """``[pairs]``, from 0 to 1: soft labels."""
    reliability: Floats
    """``[raters]``: the chance that a rater says what is so: about 0.5 for who guesses, less for who has it the wrong way round."""


class DawidSkene(NamedTuple):
    """The same, and what it rests on."""

    belief: Belief
    prior_first: float
    """The share of pairs whose first is better."""


class Davidson(NamedTuple):
    """Strengths of candidates when ties are an answer of their own."""

    strengths: dict[int, float]
    """Of each candidate, by number, on a scale of log-odds; their mean is 0."""
    tie: float
    """nu: two equals tie with chance nu / (2 + nu)."""


def believe(comparisons: Comparisons, method: Method) -> Belief:
    """By one of ``METHODS``. Raises ``UserError`` for another."""
    match method:
        case "mean":
            return mean_labels(comparisons)
        case "majority":
            return majority(comparisons)
        case "dawid_skene":
            return dawid_skene(comparisons).belief
    raise UserError(f"there is no way to aggregate labels called '{method}'; there are {', '.join(METHODS)}")


def mean_labels(comparisons: Comparisons) -> Belief:
    """The share of votes: soft labels that trust everybody alike."""
    votes = np.bincount(comparisons.pair, comparisons.value, len(comparisons.pairs))
    share = votes / np.maximum(np.bincount(comparisons.pair, minlength=len(comparisons.pairs)), 1)
    return Belief(share, _agreement_with(comparisons, share))


def majority(comparisons: Comparisons) -> Belief:
    """What most say: 0 or 1, and 0.5 where both sides have as many votes."""
    share = mean_labels(comparisons).first_is_better
    label = np.where(np.isclose(share, 0.5), 0.5, (share > 0.5).astype(np.float64))
    return Belief(label, _agreement_with(comparisons, label))


def dawid_skene(comparisons: Comparisons, prior: tuple[float, float] = (4.0, 2.0)) -> DawidSkene:
    """One-coin Dawid-Skene by EM: a rater says what is so with a chance of their own, whatever the pair.

    ``prior``: of a Beta distribution over reliabilities, as votes right and wrong that everybody is granted; its mean above 0.5 says that
    most mean well, without which right and wrong could change places. Sources: Dawid and Skene 1979, Applied Statistics 28; the one-coin
    form: Zhang et al. 2014, arXiv 1406.3824.
    """
    right, wrong = prior
    if not (wrong >= 1 and right > wrong):
        raise UserError(f"the prior is {prior}, but it must be two numbers of at least 1, the first one greater")
    pair, rater, value = comparisons.pair, comparisons.rater, comparisons.value
    votes = np.bincount(rater, minlength=len(comparisons.raters))
    first, reliability, share = mean_labels(comparisons).first_is_better, np.full(len(votes), 0.5), 0.5
    for _ in range(_ITERATIONS):
        agreed = np.bincount(rater, value * first[pair] + (1 - value) * (1 - first[pair]), len(comparisons.raters))
        # The mode of the posterior; it stays inside (0, 1), so that no rater is believed whatever others say.
        reliability = (agreed + right - 1) / (votes + right + wrong - 2)
        reliability = np.clip(reliability, 1e-6, 1 - 1e-6)
        share = float(np.clip((first.sum() + 1) / (len(first) + 2), 1e-6, 1 - 1e-6))
        evidence = (2 * value - 1) * np.log(reliability / (1 - reliability))[rater]
        odds = np.log(share / (1 - share)) + np.bincount(pair, evidence, len(comparisons.pairs))
        renewed = 1 / (1 + np.exp(-np.clip(odds, -700, 700)))
        change = float(np.abs(renewed - first).max(initial=0.0))
        first = renewed
        if change < _TOLERANCE:
            break
    return DawidSkene(Belief(first, reliability), share)


def davidson(comparisons: Comparisons, prior: float = 0.1, iterations: int = 2_000) -> Davidson:
    """Bradley-Terry strengths with ties by Davidson's model, as the mode of the posterior.

    P(tie) is proportional to nu sqrt(p_i p_j), P(i wins) to p_i. ``prior``: so many games, won and lost by halves, that every candidate
    is granted against one of strength 0; without it, one that never lost would be infinitely strong.
    Source: Davidson 1970, JASA 65, and its minorisation-maximisation: Hunter 2004, Annals of Statistics 32.
    """
    numbers = sorted({each for pair in comparisons.pairs for each in (pair.first, pair.second)})
    index = {number: place for place, number in enumerate(numbers)}
    first = np.array([index[pair.first] for pair in comparisons.pairs], np.int64)[comparisons.pair]
    second = np.array([index[pair.second] for pair in comparisons.pairs], np.int64)[comparisons.pair]
    ties = float((comparisons.value == 0.5).sum())
    # A tie counts as half a win of either.
    wins = np.bincount(first, comparisons.value, len(numbers)) + np.bincount(second, 1 - comparisons.value, len(numbers)) + prior / 2
    p, nu = np.ones(len(numbers)), 1.0
    for _ in range(iterations):
        root = np.sqrt(p[first] * p[second])
        total = p[first] + p[second] + nu * root
        shares = np.bincount(first, (1 + nu * root / (2 * p[first])) / total, len(numbers))
        shares += np.bincount(second, (1 + nu * root / (2 * p[second])) / total, len(numbers))
        renewed = wins / (shares + prior / (p + 1))
        nu_renewed = ties / float((root / total).sum()) if len(root) else 0.0
        moved = max(float(np.abs(np.log(renewed / p)).max(initial=0.0)), abs(nu_renewed - nu))
        p, nu = renewed, nu_renewed
        if moved < 1e-10:
            break
    strengths = np.log(p)
    return Davidson(dict(zip(numbers, (strengths - strengths.mean()).tolist(), strict=True)), float(nu))


def _agreement_with(comparisons: Comparisons, label: Floats) -> Floats:
    """How often each rater says what the label says, a guess where the label says nothing."""
    believed = label[comparisons.pair]
    agreed = comparisons.value * believed + (1 - comparisons.value) * (1 - believed)
    votes = np.bincount(comparisons.rater, minlength=len(comparisons.raters))
    return np.bincount(comparisons.rater, agreed, len(comparisons.raters)) / np.maximum(votes, 1)
