"""Signs that a policy exploits its reward model instead of getting better, and when to stop because of them.

Gao et al. 2022 (arXiv:2210.10760): what a reward model says goes on rising while what it stands for falls. Nobody sees the second, but the
members of an ensemble begin to disagree, texts repeat themselves or change their length, and the divergence from the base grows.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from thorndike.settings import AtLeast, MoreThan, check

NEAR_BASE = 1.0
"""Nats a text: disagreement is compared with what it was when the policy was first this far from the base."""


@dataclass(frozen=True)
class Limits:
    """What a policy is not let beyond. The last parameters that kept them are the result."""

    max_kl: Annotated[float | None, MoreThan(0)] = None  # nats a text from the base
    max_disagreement: Annotated[float | None, MoreThan(1)] = 2.0  # times the ensemble's at 1 nat; without an ensemble nothing
    max_repetition: Annotated[float | None, AtLeast(0)] = 0.25  # share of repeated pairs of tokens, above the base's
    max_length_change: Annotated[float | None, MoreThan(1)] = 3.0  # times the base's mean length, or as many times shorter

    def __post_init__(self) -> None:
        check(self)


class Signals(NamedTuple):
    """What is seen of a policy's texts."""

    kl: float
    repetition: float
    length: float
    disagreement: float | None


class Watch(NamedTuple):
    """What the signals are compared with: the base's own, which the first texts of a run are written by."""

    repetition: float | None = None
    length: float | None = None
    disagreement: float | None = None


def watched(watch: Watch, signals: Signals) -> Watch:
    """The baselines, with what these signals add to them."""
    if watch.repetition is None:
        watch = watch._replace(repetition=signals.repetition, length=signals.length)
    if watch.disagreement is None and signals.kl >= NEAR_BASE:
        watch = watch._replace(disagreement=signals.disagreement)
    return watch


def trouble(limits: Limits, watch: Watch, signals: Signals) -> str | None:
    """Which limit the policy is beyond, in words; None if it is within all."""
    if limits.max_kl is not None and signals.kl > limits.max_kl:
        return f"it is {signals.kl:.1f} nats a text from the base, more than max_kl = {limits.max_kl:g}"
    if limits.max_disagreement is not None and watch.disagreement and signals.disagreement is not None:
        times = signals.disagreement / watch.disagreement
        if times > limits.max_disagreement:
            return f"the reward models disagree {times:.1f} times as much as near the base: texts are unlike all that they were taught"
    if limits.max_repetition is not None and signals.repetition - (watch.repetition or 0.0) > limits.max_repetition:
        return f"{signals.repetition:.0%} of its texts is repetition, {watch.repetition or 0.0:.0%} of the base's"
    if limits.max_length_change is not None and watch.length:
        times = signals.length / watch.length
        if not 1 / limits.max_length_change <= times <= limits.max_length_change:
            return f"its texts have {signals.length:.0f} tokens on average, the base's {watch.length:.0f}"
    return None


def repetition(tokens: Sequence[object]) -> float:
    """The share of neighbouring pairs that stood before in the same text; 0 for texts too short to repeat any."""
    pairs = list(itertools.pairwise(tokens))
    return 1.0 - len(set(pairs)) / len(pairs) if pairs else 0.0


def mean_repetition(tokens: Int[np.ndarray, "B N"], lengths: Int[np.ndarray, " B"]) -> float:
    """The mean over rows, the last token, which ends a text, included."""
    return float(np.mean([repetition(row[:length].tolist()) for row, length in zip(tokens, lengths, strict=True)]))


def mean_disagreement(scores: Float[np.ndarray, "E B"]) -> float | None:
    """Mean over texts of the members' standard deviation; None where there is one member only."""
    return float(scores.std(axis=0).mean()) if len(scores) > 1 else None
