"""What a long run shows: a progress bar at a terminal, plain lines when piped, nothing when quiet."""

from __future__ import annotations

import math
import sys
import time
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

__all__ = ["Display", "make_console", "table"]

_SECONDS_BETWEEN_LINES = 2.0


def make_console(quiet: bool) -> Console:
    """Standard output; lines of any length stay whole when piped."""
    piped = not sys.stdout.isatty()
    return Console(quiet=quiet, highlight=False, soft_wrap=piped, width=160 if piped else None)


class _Figures(ProgressColumn):
    def render(self, task: Task) -> Text:
        return Text(str(task.fields["figures"]))


class Display:
    """Shows the progress of `iterations` iterations; a context manager.

    `first` iterations and `frames` frames were an earlier process's; they do not count for the speed.
    """

    def __init__(self, console: Console, title: str, iterations: int, first: int = 0, frames: int = 0) -> None:
        self._console, self._title, self._iterations = console, title, iterations
        self._first, self._frames = first, frames
        self._bar: Progress | None = None
        self._started = self._last_line = time.monotonic()

    def __enter__(self) -> Display:
        if self._console.is_terminal and not self._console.quiet:
            columns = (TextColumn("{task.description}"), BarColumn(), _Figures(), TimeElapsedColumn())
            self._bar = Progress(*columns, TextColumn("left"), TimeRemainingColumn(), console=self._console)
            self._bar.start()
            self._task = self._bar.add_task(self._title, total=self._iterations, completed=self._first, figures="")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()

    def update(self, iteration: int, frames: int, aihtr: float, gap: float) -> None:
        """After `iteration` iterations; `gap` is the AIHTR missing to the upper bound, nan if none is known."""
        elapsed = time.monotonic() - self._started
        speed = (frames - self._frames) / max(elapsed, 1e-9)
        figures = f"{frames:,} frames  {speed:,.0f}/s  AIHTR {aihtr:,.2f}"
        if not math.isnan(gap):
            figures += f"  gap {gap:,.2f}"
        if self._bar is not None:
            self._bar.update(self._task, completed=iteration, figures=figures)
            return
        now, last = time.monotonic(), iteration == self._iterations
        if self._console.quiet or not (
            last or iteration == self._first + 1 or now - self._last_line >= _SECONDS_BETWEEN_LINES
        ):
            return
        self._last_line = now
        left = elapsed / (iteration - self._first) * (self._iterations - iteration)
        self._console.print(f"{self._title}: {100 * iteration // self._iterations:3d} %  {figures}  {left:,.0f} s left")


def table(title: str, columns: list[str], rows: list[list[str]]) -> Table:
    """A table with its first column to the left and the others to the right."""
    made = Table(title=title, title_justify="left")
    for index, column in enumerate(columns):
        made.add_column(column, justify="left" if index == 0 else "right")
    for row in rows:
        made.add_row(*row)
    return made
