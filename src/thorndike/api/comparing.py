"""``compare``: is one trained learner better than another, and how sure is that?"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from thorndike.api.loading import load
from thorndike.errors import UserError
from thorndike.plotting.comparison import Side, plot_comparison, read_curves
from thorndike.statistics.comparison import Difference, Interval, Standing, Verdict, common_scale, compare_scores, rescaled, standing
from thorndike.statistics.estimates import RESAMPLES, Floats
from thorndike.training.run_groups import Entry, Group, Groups, RunPath, Trained, group_runs, recorded_scores


class Compared(NamedTuple):
    """One side of a comparison."""

    label: str
    runs: Mapping[str, tuple[Path, ...]]
    """Of each environment its run directories."""
    scores: Mapping[str, tuple[float, ...]]
    """Of each environment every seed's mean return over its evaluation episodes."""
    standing: Standing
    """Estimates with intervals: of returns, or on several environments of returns scaled to 0..1."""
    difference: Difference | None
    """From the baseline; None for the baseline itself."""


class Comparison(NamedTuple):
    """What ``compare`` found. The first five fields are of the first learner against the baseline."""

    verdict: Verdict
    difference: float
    ci95: Interval
    p_improvement: float
    more_seeds: int | None
    metric: str
    """What the difference is of: ``iqm`` or ``mean``."""
    baseline: str
    """Label of the side that the others are compared with."""
    environments: tuple[str, ...]
    notes: tuple[str, ...]
    """What makes the comparison less fair than it looks, a sentence each."""
    runs: tuple[Compared, ...]

    def plot(self, path: str | Path) -> Path:
        """Draw intervals, performance profiles and sample-efficiency curves into an image file (PNG, SVG or PDF by its ending)."""
        tables = _tables([side.scores for side in self.runs], self.environments)
        sides = [
            Side(side.label, table, side.standing, read_curves(side.runs)) for side, table in zip(self.runs, _scaled(tables), strict=True)
        ]
        return plot_comparison(sides, self.environments, Path(path))


def compare(
    runs: Sequence[Entry] | Mapping[str, Entry],
    *,
    metric: str = "iqm",
    episodes: int = 100,
    against: RunPath | None = None,
    failed_below: float | Mapping[str, float] | None = None,
    resamples: int = RESAMPLES,
) -> Comparison:
    """Compare learners by the returns of their seeds on reference environments.

    ``runs`` are run directories, one a learner; several directories together (``[["a", "a2"], "b"]``) are more seeds of one learner; runs
    of one learner on several environments are found by their algorithm or ``name``; a mapping gives labels. ``against`` (a run, or a key
    of the mapping) is the baseline, the last learner otherwise. A run's last recorded evaluation counts if it has at least ``episodes``
    episodes of every seed; otherwise all seeds are evaluated now. ``metric`` is what the verdict is about, ``iqm`` or ``mean``. A seed
    whose mean return is below ``failed_below`` (a number, or one for each environment) has failed. Returns of several environments are
    scaled to 0..1 by the range of all seeds. How the verdict is reached: ``thorndike.statistics.comparison.compare_scores``.

    Raises UserError for fewer than two learners, runs without a common environment, and seeds that cannot be pooled.
    """
    found = group_runs(runs, against)
    thresholds = _thresholds(failed_below, found.environments)
    scores = [_scores(group, episodes) for group in found.groups]
    tables = _tables(scores, found.environments)
    low, high = _scale(tables)
    scaled = [rescaled(table, low, high) for table in tables]
    threshold = None if thresholds is None else rescaled(thresholds, low, high)
    labels = [group.label for group in found.groups]
    baseline = scaled[labels.index(found.baseline)]
    sides = []
    for group, told, table in zip(found.groups, scores, scaled, strict=True):
        others = None if group.label == found.baseline else baseline
        difference = (
            None if others is None else compare_scores(table, others, metric=metric, comparisons=len(labels) - 1, resamples=resamples)
        )
        directories = {environment: tuple(trained.run for trained in together) for environment, together in group.runs.items()}
        sides.append(Compared(group.label, directories, told, standing(table, threshold=threshold, resamples=resamples), difference))
    return _comparison(found, metric, sides, (*found.notes, *_notes(found, scores)))


def _comparison(found: Groups, metric: str, sides: Sequence[Compared], notes: Sequence[str]) -> Comparison:
    first = next(side.difference for side in sides if side.difference is not None)
    told = (first.verdict, first.difference, first.ci95, first.p_improvement.value, first.more_seeds)
    return Comparison(*told, metric, found.baseline, found.environments, tuple(notes), tuple(sides))


def _scores(group: Group, episodes: int) -> dict[str, tuple[float, ...]]:
    return {
        environment: tuple(score for trained in together for score in _of_seeds(trained, episodes))
        for environment, together in group.runs.items()
    }


def _of_seeds(trained: Trained, episodes: int) -> Sequence[float]:
    recorded = recorded_scores(trained, episodes)
    return load(trained.run).evaluate(episodes).per_seed if recorded is None else recorded


def _tables(scores: Sequence[Mapping[str, Sequence[float]]], environments: Sequence[str]) -> list[Floats]:
    """One table ``[seeds, environments]`` a learner. Where it has more seeds on one environment, the first ones count."""
    fewest = [min(len(told[environment]) for environment in environments) for told in scores]
    return [
        np.array([told[environment][:count] for environment in environments], np.float64).T
        for told, count in zip(scores, fewest, strict=True)
    ]


def _scale(tables: Sequence[Floats]) -> tuple[Floats, Floats]:
    """What becomes 0 and 1; on a single environment returns stay what they are."""
    tasks = tables[0].shape[1]
    return (np.zeros(1), np.ones(1)) if tasks == 1 else common_scale(tables)


def _scaled(tables: Sequence[Floats]) -> list[Floats]:
    low, high = _scale(tables)
    return [rescaled(table, low, high) for table in tables]


def _thresholds(failed_below: float | Mapping[str, float] | None, environments: Sequence[str]) -> list[float] | None:
    if failed_below is None or not isinstance(failed_below, Mapping):
        return None if failed_below is None else [failed_below] * len(environments)
    missing = [environment for environment in environments if environment not in failed_below]
    if missing:
        raise UserError(
            f"failed_below has no return for {', '.join(missing)}: give one number, or one for each of {', '.join(environments)}"
        )
    return [failed_below[environment] for environment in environments]


def _notes(found: Groups, scores: Sequence[Mapping[str, Sequence[float]]]) -> list[str]:
    notes = []
    if len(found.environments) > 1:
        notes.append(
            f"the environments differ ({', '.join(found.environments)}): returns are scaled to 0..1 by the range of all seeds on each"
        )
    for group, told in zip(found.groups, scores, strict=True):
        counts = {environment: len(values) for environment, values in told.items()}
        if len(set(counts.values())) > 1:
            some = ", ".join(f"{count} on {environment}" for environment, count in counts.items())
            notes.append(f"{group.label} has different numbers of seeds ({some}): the first {min(counts.values())} of each count")
    return notes
