"""How good a reward model is on comparisons that it did not learn from: accuracy with its interval, calibration, accuracy by gap."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from thorndike.errors import UserError
from thorndike.statistics.estimates import wilson_interval

_BINS = 10


class GapAccuracy(NamedTuple):
    """Accuracy on pairs that are about as far apart."""

    low: float
    high: float
    pairs: int
    accuracy: float


class HeldOut(NamedTuple):
    """What was found on held-out pairs that are no ties."""

    pairs: int
    accuracy: float
    accuracy_ci95: tuple[float, float]
    calibration_error: float
    """Expected calibration error (ECE) of ``sigmoid(r_first - r_second)``, in ten bins. Guo et al. 2017 (arXiv:1706.04599)."""
    by_gap: tuple[GapAccuracy, ...]
    """By quartile of the gap: of the labels' own where they have one, else of the rewards."""

    @property
    def near_chance(self) -> bool:
        """Whether guessing would explain it: 0.5 is inside the interval, or above it."""
        return self.accuracy_ci95[0] <= 0.5


def held_out_report(
    first: Float[np.ndarray, " N"],
    second: Float[np.ndarray, " N"],
    p_first: Float[np.ndarray, " N"],
    gap: Float[np.ndarray, " N"] | None = None,
    independent: int | None = None,
) -> HeldOut:
    """The report of rewards of pairs. A pair is right where the likelier one has the higher reward; equal rewards count half.

    ``independent``: how many pairs' worth of evidence there is, where texts are in several pairs; the interval is as wide as that. Raises
    ``UserError`` if all pairs are ties.
    """
    sure = p_first != 0.5
    if not sure.any():
        raise UserError("the held-out comparisons are all ties: a reward model's accuracy needs some in which one text is better")
    margin = np.where(p_first > 0.5, first - second, second - first)[sure].astype(np.float64)
    right = np.where(margin == 0, 0.5, margin > 0)
    accuracy, trials = float(right.mean()), min(int(sure.sum()), independent or int(sure.sum()))
    by = np.abs(margin) if gap is None else np.abs(gap[sure])
    return HeldOut(
        pairs=int(sure.sum()),
        accuracy=accuracy,
        accuracy_ci95=wilson_interval(min(accuracy * trials, trials), trials),
        calibration_error=expected_calibration_error(1.0 / (1.0 + np.exp(-np.abs(margin))), right),
        by_gap=tuple(_by_quartile(by, right)),
    )


def expected_calibration_error(confidence: Float[np.ndarray, " N"], right: Float[np.ndarray, " N"]) -> float:
    """Mean distance of confidence (0.5 to 1) and accuracy over bins, weighted by how many fall into each."""
    bins = np.minimum(((confidence - 0.5) * 2 * _BINS).astype(int), _BINS - 1)
    inside = [bins == number for number in range(_BINS) if (bins == number).any()]
    return float(sum(abs(confidence[each].mean() - right[each].mean()) * each.mean() for each in inside))


def _by_quartile(gap: Float[np.ndarray, " N"], right: Float[np.ndarray, " N"]) -> Sequence[GapAccuracy]:
    parts = [part for part in np.array_split(np.argsort(gap, kind="stable"), 4) if len(part)]
    return [GapAccuracy(float(gap[part[0]]), float(gap[part[-1]]), len(part), float(right[part].mean())) for part in parts]
