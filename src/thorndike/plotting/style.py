"""How every picture looks, and how it is written."""

import importlib.util
from pathlib import Path
from typing import TYPE_CHECKING

from thorndike.errors import UserError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FORMATS = (".png", ".svg", ".pdf")

# Wong 2011, Nature Methods 8, 441: told apart by colour-blind readers too.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
STYLE = {
    "font.size": 10.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#888888",
    "axes.axisbelow": True,
    "axes.grid": True,
    "grid.color": "#E4E4E4",
    "grid.linewidth": 0.8,
    "xtick.color": "#555555",
    "ytick.color": "#555555",
    "axes.labelcolor": "#222222",
    "legend.frameon": False,
    "savefig.dpi": 150,
    "svg.hashsalt": "thorndike",
}


def check_plot_file(path: Path) -> None:
    """Raises UserError if the ending of `path` is no format a plot is written in, or Matplotlib is not installed."""
    if path.suffix.lower() not in FORMATS:
        raise UserError(f"a plot is written as {', '.join(FORMATS)}; got '{path.name}'")
    if importlib.util.find_spec("matplotlib") is None:
        raise UserError("drawing needs Matplotlib: pip install 'thorndike[plot]'")


def save_figure(figure: "Figure", path: Path) -> Path:
    """Write a figure, the same bytes each time."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, metadata={"Date": None} if path.suffix.lower() == ".svg" else None)
    return path


def short_number(number: float) -> str:
    """A number as it stands at an axis: ``50k``, ``1.5M``."""
    for size, letter in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(number) >= size:
            return f"{number / size:g}{letter}"
    return f"{number:g}"


def counted(number: int, noun: str) -> str:
    """``1 seed``, ``2 seeds``."""
    return f"{number} {noun}" + ("" if number == 1 else "s")
