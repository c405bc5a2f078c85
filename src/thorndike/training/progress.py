"""The progress bar of long work: steps, steps a second, the return with its interval, the time left."""

import sys
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bar
from rich.table import Column


class Progress:
    """A bar on stderr, there only when `enabled` and stderr is a terminal: logs and pipes stay clean.

    Use it as a context manager, or call `close`. `update` is cheap: the screen is drawn ten times a second at most.
    """

    def __init__(self, total_steps: int, enabled: bool = True, *, done_steps: int = 0, console: Console | None = None) -> None:
        """`done_steps`: where a resumed run starts. `console`: elsewhere than stderr, for tests."""
        self._total = total_steps
        self._bar: Bar | None = None
        screen = console if console is not None else Console(file=sys.stderr)
        if enabled and screen.is_terminal:
            # The bar takes what the words leave, so that these fit into 80 columns.
            columns = (BarColumn(None, table_column=Column(ratio=1)), _words("{task.description}"), TimeRemainingColumn(), _words("left"))
            self._bar = Bar(*columns, console=screen, expand=True)
            start = describe(total_steps, done_steps, None, None, None)
            self._task = self._bar.add_task(f"{start} · compiling", total=total_steps, completed=done_steps)
            self._bar.start()

    def update(
        self, steps: int, mean_return: float | None = None, interval: tuple[float, float] | None = None, steps_per_s: float | None = None
    ) -> None:
        """Show that `steps` of all the steps are done; a figure that is not known yet is None and not shown."""
        if self._bar is not None:
            self._bar.update(self._task, completed=steps, description=describe(self._total, steps, mean_return, interval, steps_per_s))

    def close(self) -> None:
        """Take the bar off; its last state stays on the screen."""
        if self._bar is not None:
            self._bar.stop()
            self._bar = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


def _words(text: str) -> TextColumn:
    return TextColumn(text, table_column=Column(no_wrap=True))


def describe(total: int, steps: int, mean_return: float | None, interval: tuple[float, float] | None, steps_per_s: float | None) -> str:
    """The words beside the bar, for example ``51k/100k steps · 320k/s · return 212.4 [180.1, 240.9]``."""
    parts = [f"{_short(steps)}/{_short(total)} steps"]
    if steps_per_s is not None:
        parts.append(f"{_short(steps_per_s)}/s")
    if mean_return is not None:
        ends = "" if interval is None else f" [{interval[0]:.4g}, {interval[1]:.4g}]"
        parts.append(f"return {mean_return:.4g}{ends}")
    # A bracket opens a style in rich's markup unless it is escaped.
    return " · ".join(parts).replace("[", r"\[")


def _short(number: float) -> str:
    for size, letter in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if number >= size:
            return f"{number / size:.3g}{letter}"
    return f"{number:.3g}"
