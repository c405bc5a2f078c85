"""A comparison in one picture: intervals, performance profiles, and sample-efficiency curves with bands."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from thorndike.plotting.learning_curve import METRIC, Curve, carried_forward, read_curve
from thorndike.plotting.style import COLOURS, STYLE, check_plot_file, counted, save_figure, short_number
from thorndike.statistics.comparison import Estimate, Standing
from thorndike.statistics.estimates import Floats
from thorndike.statistics.profiles import Band, performance_profile, sample_efficiency

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_PANELS_A_ROW = 3


class Side(NamedTuple):
    """What is drawn of one learner."""

    label: str
    scores: Floats
    """``[seeds, environments]``, on one scale."""
    standing: Standing
    curves: Mapping[str, Sequence[Curve]]
    """Learning curves of each environment; the seeds of several count together."""


def read_curves(runs: Mapping[str, Sequence[Path]]) -> dict[str, list[Curve]]:
    """The learning curves of each environment's runs; a run that logs none, such as a plan, has none."""
    found = {place: [read_curve(run, METRIC) for run in together if (run / "metrics.jsonl").is_file()] for place, together in runs.items()}
    return {place: curves for place, curves in found.items() if curves}


def plot_comparison(sides: Sequence[Side], environments: Sequence[str], path: Path) -> Path:
    """Draw learners side by side and write the picture; returns its path.

    The ending of `path` chooses the format. Raises UserError for another ending, or if Matplotlib is not installed.
    """
    check_plot_file(path)
    from matplotlib import style

    with style.context(STYLE):
        return save_figure(_draw(sides, environments), path)


def _draw(sides: Sequence[Side], environments: Sequence[str]) -> "Figure":
    from matplotlib.figure import Figure

    shown = list(dict.fromkeys(environment for side in sides for environment in side.curves))
    rows = -(-len(shown) // _PANELS_A_ROW)
    figure = Figure(figsize=(10.0, 3.6 + 3.2 * rows), layout="constrained")
    top, *below = figure.subfigures(1 + rows, 1, squeeze=False)[:, 0]
    left, right = top.subplots(1, 2)
    scale = "mean return of a seed" if len(environments) == 1 else "return of a seed, scaled to 0..1 on each environment"
    _draw_intervals(left, sides, scale)
    _draw_profiles(right, sides, scale)
    for row, panel in enumerate(below):
        part = shown[row * _PANELS_A_ROW : (row + 1) * _PANELS_A_ROW]
        for axes, environment in zip(np.atleast_1d(panel.subplots(1, len(part))), part, strict=True):
            _draw_curves(axes, sides, environment)
    figure.suptitle(" and ".join(environments) if len(environments) < 4 else f"{len(environments)} environments", fontweight="bold")
    figure.supxlabel("bars and bands: 95 % bootstrap intervals over seeds", x=0.99, ha="right", fontsize=8, color="#777777")
    return figure


def _draw_intervals(axes: "Axes", sides: Sequence[Side], scale: str) -> None:
    """A row a learner: every score as a dot, the interquartile mean above, the mean below them."""
    for row, side in enumerate(sides):
        colour = COLOURS[row % len(COLOURS)]
        scores = side.scores.reshape(-1)
        axes.plot(scores, np.full(scores.size, row), "o", color=colour, alpha=0.35, markersize=4, markeredgewidth=0)
        _draw_estimate(axes, side.standing.iqm, row - 0.22, colour, "D", "interquartile mean" if row == 0 else None)
        _draw_estimate(axes, side.standing.mean, row + 0.22, colour, "s", "mean" if row == 0 else None)
    axes.set_yticks(range(len(sides)), [f"{side.label}\n{counted(side.standing.seeds, 'seed')}" for side in sides])
    axes.set_ylim(len(sides) - 0.5, -0.5)
    axes.grid(visible=False, axis="y")
    axes.set_xlabel(scale)
    axes.set_title("scores and intervals", loc="left", fontsize=10)
    axes.legend(loc="best", fontsize=8)


def _draw_estimate(axes: "Axes", estimate: Estimate, row: float, colour: str, marker: str, label: str | None) -> None:
    axes.plot(estimate.ci95, [row, row], color=colour, linewidth=3.0, alpha=0.6, solid_capstyle="butt")
    axes.plot(estimate.value, row, marker, color=colour, markersize=5, linestyle="none", label=label)


def _draw_profiles(axes: "Axes", sides: Sequence[Side], scale: str) -> None:
    scores = np.unique(np.concatenate([side.scores.reshape(-1) for side in sides]))
    # A little beyond both ends, so that a profile is seen to start at one and to end at nothing.
    margin = 0.03 * (float(np.ptp(scores)) or 1.0)
    thresholds = np.array([scores[0] - margin, *scores, scores[-1] + margin])
    for index, side in enumerate(sides):
        band = performance_profile(side.scores, thresholds)
        _draw_band(axes, thresholds, band, COLOURS[index % len(COLOURS)], side.label, steps=True)
    axes.set_ylim(-0.02, 1.02)
    axes.set_xlabel(scale)
    axes.set_ylabel("share of seeds above")
    axes.set_title("performance profile", loc="left", fontsize=10)
    axes.legend(loc="best", fontsize=8)


def _draw_curves(axes: "Axes", sides: Sequence[Side], environment: str) -> None:
    for index, side in enumerate(sides):
        if environment not in side.curves:
            continue
        steps, values = _together(side.curves[environment])
        _draw_band(axes, steps, sample_efficiency(values.T[:, None, :]), COLOURS[index % len(COLOURS)], side.label)
    axes.set_xlim(left=0)
    axes.xaxis.set_major_formatter(lambda steps, _: short_number(steps))
    axes.set_xlabel("environment steps of each seed")
    axes.set_ylabel("return of training episodes")
    axes.set_title(f"sample efficiency, {environment}", loc="left", fontsize=10)
    axes.legend(loc="best", fontsize=8)


def _draw_band(axes: "Axes", where: Floats, band: Band, colour: str, label: str, steps: bool = False) -> None:
    """``steps``: what holds at a point holds up to the next one."""
    axes.fill_between(where, band.low, band.high, step="post" if steps else None, color=colour, alpha=0.22, linewidth=0)
    axes.plot(where, band.value, drawstyle="steps-post" if steps else "default", color=colour, linewidth=1.8, label=label)


def _together(curves: Sequence[Curve]) -> tuple[Floats, Floats]:
    """Steps ``[points]`` and values ``[points, seeds]`` of all seeds, at the log points that every one of them has."""
    steps = curves[0].steps
    for curve in curves[1:]:
        steps = np.intersect1d(steps, curve.steps)
    values = np.concatenate([carried_forward(curve.values)[np.isin(curve.steps, steps)] for curve in curves], axis=1)
    known = np.isfinite(values).all(axis=1)
    return steps[known], values[known]
