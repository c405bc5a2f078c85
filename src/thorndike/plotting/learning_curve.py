"""Learning curves of one or several runs, with their 95 % interval over seeds, as PNG, SVG or PDF."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from thorndike.errors import UserError
from thorndike.plotting.style import COLOURS, STYLE, check_plot_file, counted, save_figure, short_number
from thorndike.statistics.estimates import mean_interval_over_seeds
from thorndike.suggestions import did_you_mean
from thorndike.training.json_files import TEXT, blamed_on, check_fields, parse_object, read_object

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats: TypeAlias = NDArray[np.float64]

METRIC = "rollout/ep_rew_mean"

_TITLES = {
    "rollout/ep_rew_mean": "mean return of training episodes",
    "rollout/ep_len_mean": "mean length of training episodes (steps)",
    "eval/mean_reward": "mean return of evaluation episodes",
    "time/fps": "steps per second",
}


class Curve(NamedTuple):
    """One metric of one run."""

    steps: Floats
    """Environment steps of each seed at each log point ``[P]``."""
    values: Floats
    """The metric ``[P, S]``, NaN where a seed has none yet."""
    algorithm: str
    environment: str
    name: str
    """The run directory's own name."""


def read_curve(run: Path, metric: str = METRIC) -> Curve:
    """One metric of a run from its ``metrics.jsonl``; points where no seed has a value are left out.

    Raises UserError if the run has logged nothing, or nothing under this name.
    """
    facts = read_object(run / "run.json")
    check_fields(facts, {"algorithm": TEXT, "environment": TEXT}, run / "run.json")
    path = run / "metrics.jsonl"
    # A run that was killed may have left half a line: whatever no newline ends is not there yet.
    lines = path.read_bytes().split(b"\n")[:-1] if path.is_file() else []
    rows = [parse_object(line, path) for line in lines if line]
    if not rows:
        raise UserError(f"{run} has logged nothing yet: {path.name} is missing or empty; train longer")
    known = {name for row in rows for name in row if name != "steps"}
    if metric not in known:
        raise UserError(f"{run} has no metric '{metric}'{did_you_mean(metric, known)}")
    chosen = [row for row in rows if metric in row]
    # What is measured of the whole run, such as time/fps, is one number and not one a seed.
    with blamed_on(path):
        cells = [cell if isinstance(cell, list) else [cell] for cell in (row[metric] for row in chosen)]
        values = np.array([[np.nan if value is None else value for value in row] for row in cells], np.float64)
        steps = np.array([row["steps"] for row in chosen], np.float64)
    kept = np.isfinite(values).any(axis=1)
    if not kept.any():
        raise UserError(f"{run}: no value of '{metric}' yet, so there is nothing to draw; train longer")
    return Curve(
        steps[kept], np.where(np.isfinite(values), values, np.nan)[kept], str(facts["algorithm"]), str(facts["environment"]), run.name
    )


def plot_learning_curves(curves: Sequence[Curve], path: Path, *, metric: str = METRIC, title: str | None = None) -> Path:
    """Draw curves over each other (mean over seeds, shaded 95 % bootstrap interval) and write the picture; returns its path.

    The ending of `path` chooses the format. Raises UserError for another ending, or if Matplotlib is not installed.
    """
    check_plot_file(path)
    from matplotlib import style

    with style.context(STYLE):
        return save_figure(_draw(curves, metric, title), path)


def carried_forward(values: Floats) -> Floats:
    """Curves ``[P, S]`` in which a seed without a value at a point keeps the one before; NaN stays before its first value.

    Where episodes are longer than the distance of two log points, a mean over only the seeds that ended one there would jump about.
    """
    points = np.arange(len(values))[:, None]
    latest = np.maximum.accumulate(np.where(np.isfinite(values), points, 0), axis=0)
    return np.take_along_axis(values, latest, axis=0)


def labels(curves: Sequence[Curve]) -> list[str]:
    """A legend entry a curve: as short as tells them apart, with the number of seeds."""
    environments = {curve.environment for curve in curves}
    names = [f"{curve.algorithm}" + (f" on {curve.environment}" if len(environments) > 1 else "") for curve in curves]
    told_apart = [f"{name} ({curve.name})" if names.count(name) > 1 else name for name, curve in zip(names, curves, strict=True)]
    return [f"{name}, {counted(curve.values.shape[1], 'seed')}" for name, curve in zip(told_apart, curves, strict=True)]


def _draw(curves: Sequence[Curve], metric: str, title: str | None) -> "Figure":
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 4.2), layout="constrained")
    axes = figure.add_subplot()
    for index, (curve, label) in enumerate(zip(curves, labels(curves), strict=True)):
        _draw_one(axes, curve, label, COLOURS[index % len(COLOURS)], each_seed=len(curves) == 1)
    axes.set_xlabel("environment steps of each seed")
    axes.set_ylabel(_TITLES.get(metric, metric))
    axes.set_xlim(left=0)
    axes.xaxis.set_major_formatter(lambda steps, _: short_number(steps))
    axes.set_title(title or " and ".join(dict.fromkeys(curve.environment for curve in curves)), loc="left", fontweight="bold")
    axes.legend(loc="best")
    if any(curve.values.shape[1] > 1 for curve in curves):
        figure.supxlabel("line: mean over seeds; band: its 95 % bootstrap interval", x=0.99, ha="right", fontsize=8, color="#777777")
    return figure


def _draw_one(axes: "Axes", curve: Curve, label: str, colour: str, each_seed: bool) -> None:
    values = carried_forward(curve.values)
    mean, low, high = mean_interval_over_seeds(values)
    if curve.values.shape[1] > 1:
        axes.fill_between(curve.steps, low, high, color=colour, alpha=0.22, linewidth=0)
    if curve.values.shape[1] > 1 and each_seed:
        axes.plot(curve.steps, values, color=colour, alpha=0.25, linewidth=0.6)
    marker = "o" if len(curve.steps) == 1 else ""
    axes.plot(curve.steps, mean, color=colour, linewidth=1.8, marker=marker, label=label)
