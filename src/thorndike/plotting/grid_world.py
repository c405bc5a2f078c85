"""Values and a policy drawn on the map they belong to: as text with arrows, or as a PNG. Tasks without a map become a list of states."""

from pathlib import Path
from typing import NamedTuple

import gymnasium
import numpy as np
from jaxtyping import Float, Int

from thorndike.errors import UserError

_TARGETS = "HGC"
"""Letters of tiles that end the episode (hole, goal) or send the walker back (cliff): no action is drawn on them."""


class Grid(NamedTuple):
    """The map of a grid world, state by state in rows."""

    letters: tuple[str, ...]
    """One string a row, one letter a tile: S start, F floor, H hole, G goal, C cliff."""
    arrows: str
    """One arrow an action."""


def read_grid(environment: gymnasium.Env) -> Grid | None:
    """The map of a FrozenLake or CliffWalking environment (or one built like them), None for any other."""
    unwrapped = environment.unwrapped
    if hasattr(unwrapped, "desc") and hasattr(unwrapped, "nrow"):
        rows = tuple(b"".join(row).decode() for row in np.asarray(unwrapped.get_wrapper_attr("desc"), "S1"))
        return Grid(rows, "←↓→↑")
    if hasattr(unwrapped, "_cliff") and hasattr(unwrapped, "start_state_index"):
        letters = np.where(unwrapped.get_wrapper_attr("_cliff"), "C", "F")
        letters.flat[unwrapped.get_wrapper_attr("start_state_index")] = "S"
        letters[-1, -1] = "G"
        return Grid(tuple("".join(row) for row in letters), "↑→↓←")
    return None


def picture(grid: Grid | None, values: Float[np.ndarray, " states"], policy: Int[np.ndarray, " states"]) -> str:
    """Values and greedy actions as text: two lines a row of the map, or one line a state where there is no map.

    Raises UserError if the map and the values differ in size.
    """
    if grid is None:
        lines = [f"{'state':>6} {'action':>6} {'value':>12}"]
        lines += [f"{state:>6} {action:>6} {value:>12.6f}" for state, (action, value) in enumerate(zip(policy, values, strict=True))]
        return "\n".join(lines)
    width = max(len(f"{value:.4f}") for value in values) + 2
    rule = "+".join(["", *["-" * width] * len(grid.letters[0]), ""])
    lines = [rule]
    marks, table = _marks(grid, values, policy), values.reshape(len(grid.letters), -1)
    for letters, arrows, numbers in zip(grid.letters, marks, table, strict=True):
        lines.append("|".join(["", *(f"{letter} {arrow}".center(width) for letter, arrow in zip(letters, arrows, strict=True)), ""]))
        lines.append("|".join(["", *(f"{number:.4f}".center(width) for number in numbers), ""]))
        lines.append(rule)
    return "\n".join(lines)


def save_picture(grid: Grid, values: Float[np.ndarray, " states"], policy: Int[np.ndarray, " states"], path: Path) -> Path:
    """Draw values as colours and greedy actions as arrows into an image file, and return its path. Raises UserError without Matplotlib."""
    try:
        from matplotlib.figure import Figure
    except ModuleNotFoundError:
        raise UserError("drawing needs Matplotlib: pip install 'thorndike[plot]'") from None
    marks, table = _marks(grid, values, policy), values.reshape(len(grid.letters), -1)
    rows, columns = table.shape
    figure = Figure(figsize=(1.0 + columns * 0.9, 0.6 + rows * 0.9), layout="constrained")
    axes = figure.subplots()
    image = axes.imshow(table, cmap="viridis")
    middle = (table.min() + table.max()) / 2
    for row, column in np.ndindex(rows, columns):
        colour = "black" if table[row, column] > middle else "white"
        text = f"{grid.letters[row][column]} {marks[row][column]}\n{table[row, column]:.3f}"
        axes.text(column, row, text, ha="center", va="center", color=colour, fontsize=9)
    axes.set_xticks([])
    axes.set_yticks([])
    figure.colorbar(image, label="value")
    figure.savefig(path, dpi=120)
    return path


def _marks(grid: Grid, values: Float[np.ndarray, " states"], policy: Int[np.ndarray, " states"]) -> list[list[str]]:
    """The arrow of every tile, blank where nothing is chosen."""
    tiles = len(grid.letters) * len(grid.letters[0])
    if len(values) != tiles or len(policy) != tiles:
        raise UserError(
            f"the map has {tiles} tiles, but there are {len(values)} values and {len(policy)} actions: pass those of one environment"
        )
    flat = "".join(grid.letters)
    arrows = [" " if letter in _TARGETS else grid.arrows[action] for letter, action in zip(flat, policy, strict=True)]
    width = len(grid.letters[0])
    return [arrows[start : start + width] for start in range(0, tiles, width)]
