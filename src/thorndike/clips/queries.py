"""Which clips to ask about: pairs on which the members of an ensemble disagree most."""

import numpy as np
from jaxtyping import Float, Int

CANDIDATES = 10
"""Pairs that are looked at for each that is asked: Christiano et al. 2017, section 2.2.4, draw more than they ask, without a number."""


def disagreement(sums: Float[np.ndarray, "E N"], pairs: Int[np.ndarray, "P 2"]) -> Float[np.ndarray, " P"]:
    """The deviation, over members, of the probability that the first of a pair is preferred; ``sums`` are the clips' predicted returns."""
    margin = sums[:, pairs[:, 0]] - sums[:, pairs[:, 1]]
    return np.std(0.5 * (1.0 + np.tanh(0.5 * margin)), axis=0)


def random_pairs(clips: int, count: int, dice: np.random.Generator) -> Int[np.ndarray, "P 2"]:
    """Different pairs of different clips, ``count`` or as many as there are, each the other way round as often as not."""
    first, second = np.triu_indices(clips, k=1)
    chosen = dice.choice(len(first), min(count, len(first)), replace=False)
    pairs = np.stack([first[chosen], second[chosen]], axis=1)
    return dice.permuted(pairs, axis=1)


def pairs_to_ask(clips: int, count: int, dice: np.random.Generator, sums: Float[np.ndarray, "E N"] | None = None) -> Int[np.ndarray, "P 2"]:
    """The pairs to ask: any, or with ``sums`` those of ``CANDIDATES`` times as many on which members disagree most."""
    if sums is None or len(sums) < 2:
        return random_pairs(clips, count, dice)
    drawn = random_pairs(clips, CANDIDATES * count, dice)
    return drawn[np.argsort(-disagreement(sums, drawn), kind="stable")[:count]]
