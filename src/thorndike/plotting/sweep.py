"""Response curves of a sweep: a panel a setting, a dot a trial, the mean with its 95 % interval, the winner marked."""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from thorndike.plotting.style import COLOURS, STYLE, check_plot_file, counted, save_figure, short_number
from thorndike.statistics.estimates import Floats
from thorndike.statistics.sweeps import Effect, Point

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_PANELS_IN_A_ROW = 3
_UPRIGHT_LABELS = 5


def plot_sweep(
    effects: Sequence[Effect],
    columns: Mapping[str, Sequence[object]],
    means: Floats,
    best: int,
    logarithmic: Collection[str],
    title: str,
    path: Path,
) -> Path:
    """Draw a sweep and write the picture; returns its path, whose ending chooses the format.

    ``columns``: of each setting the value of every trial ``[N]``; ``means``: their scores ``[N]``; ``best``: the winning trial;
    ``logarithmic``: settings drawn from a logarithmic range. Raises UserError for another ending, or if Matplotlib is not installed.
    """
    check_plot_file(path)
    from matplotlib import style

    with style.context(STYLE):
        return save_figure(_draw(effects, columns, means, best, logarithmic, title), path)


def _draw(
    effects: Sequence[Effect],
    columns: Mapping[str, Sequence[object]],
    means: Floats,
    best: int,
    logarithmic: Collection[str],
    title: str,
) -> "Figure":
    from matplotlib.figure import Figure

    across = min(len(effects), _PANELS_IN_A_ROW)
    down = -(-len(effects) // across)
    figure = Figure(figsize=(0.6 + 3.6 * across, 0.6 + 3.2 * down), layout="constrained")
    for index, effect in enumerate(effects):
        axes = figure.add_subplot(down, across, index + 1)
        _panel(axes, effect, columns[effect.name], means, best, effect.name in logarithmic)
        if index % across == 0:
            axes.set_ylabel("mean return of a trial")
    figure.suptitle(f"{title}: {counted(len(means), 'trial')}", x=0.01, ha="left", fontweight="bold")
    figure.supxlabel("dot: a trial; line: mean, its 95 % interval; star: the winner", x=0.99, ha="right", fontsize=8, color="#777777")
    return figure


def _panel(axes: "Axes", effect: Effect, column: Sequence[object], means: Floats, best: int, logarithmic: bool) -> None:
    numeric = all(isinstance(value, int | float) and not isinstance(value, bool) for value in column)
    labels = [] if numeric else [point.values[0] for point in effect.points]
    places = [float(value) if numeric else float(labels.index(value)) for value in column]  # type: ignore[arg-type]
    line = [_place(point, labels, logarithmic or _spans_decades(places)) for point in effect.points]
    if numeric and (logarithmic or _spans_decades(places)):
        axes.set_xscale("log")
        axes.tick_params(axis="x", which="minor", labelbottom=False)
    low, high = zip(*[point.ci95 for point in effect.points], strict=True)
    axes.scatter(places, means, s=14, color="#999999", alpha=0.7, linewidths=0)
    axes.fill_between(line, low, high, color=COLOURS[0], alpha=0.2, linewidth=0)
    axes.plot(line, [point.mean for point in effect.points], color=COLOURS[0], marker="o", markersize=3.5, linewidth=1.8)
    axes.scatter(places[best], means[best], s=110, marker="*", color=COLOURS[1], zorder=3)
    if not numeric:
        axes.set_xticks(range(len(labels)), [_text(label) for label in labels])
    elif all(len(point.values) == 1 for point in effect.points):
        axes.set_xticks(line, [short_number(place) for place in line], rotation=45 if len(line) > _UPRIGHT_LABELS else 0)
    axes.set_xlabel(effect.name)
    axes.set_title(effect.verdict, fontsize=9, color="#555555")


def _place(point: Point, labels: Sequence[object], logarithmic: bool) -> float:
    """Where a point of the curve stands: at its value, or in the middle of its bin."""
    if labels:
        return float(labels.index(point.values[0]))
    ends = [float(str(value)) for value in point.values]
    return float(np.exp(np.mean(np.log(ends)))) if logarithmic else float(np.mean(ends))


def _spans_decades(places: Sequence[float]) -> bool:
    return min(places) > 0 and max(places) / min(places) >= 20


def _text(value: object) -> str:
    return ",".join(map(str, value)) if isinstance(value, tuple) else str(value)
