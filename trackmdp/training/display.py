"""The display of a long run: a progress bar at a terminal, plain lines when piped, nothing when quiet."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console, RenderableType
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.status import Status
from rich.table import Column, Table
from rich.text import Text

from trackmdp.notebook.card import counted_words, decimal
from trackmdp.signals import ENDING, handled, stop
from trackmdp.training.callbacks import Callback, Row, Training
from trackmdp.untrusted import printable

_SECONDS_BETWEEN_LINES = 2.0
_FIGURES_WIDTH = 62
"""Columns of `300,000 frames AIHTR -2,985.00 gap 3,102.25 left > 0:00:04`, and of the gaps between."""


def make_console(quiet: bool) -> Console:
    """Standard output; lines of any length stay whole when piped."""
    piped = not sys.stdout.isatty()
    return _Console(
        quiet=quiet,
        markup=False,
        emoji=False,
        highlight=False,
        soft_wrap=piped,
        width=160 if piped else None,
    )


class _Console(Console):
    """Shows text as it is: a folder's name or a log's label is neither markup nor a control sequence."""

    def render_str(self, text: str, **options: Any) -> Text:
        return super().render_str(printable(text), **options)

    def status(self, status: RenderableType, **options: Any) -> Status:
        return super().status(
            Text(printable(status)) if isinstance(status, str) else status, **options
        )


class Display(Callback):
    """Shows how far the run is and the figures of its last evaluation.

    The time left takes the iterations to come for as long as those so far. Where the last one plans it is the least.

    Args:
        console: where; a bar at a terminal, else a line now and then.
        title: name of the run.
    """

    def __init__(self, console: Console, title: str) -> None:
        self._console, self._title = console, title
        self._bar: Progress | None = None

    def on_start(self, trainer: Training) -> None:
        """Begin the bar where the run is; iterations of an earlier process do not count for the speed."""
        self._first = trainer.position
        self._started = self._last_line = time.monotonic()
        self._least = trainer.config.algo.plans_at_end
        if self._console.is_terminal and not self._console.quiet:
            # The rest of the line after title, figures and time: a line that wraps scrolls at each refresh.
            room = self._console.width - len(self._title) - _FIGURES_WIDTH
            bar = [BarColumn(min(40, room))] if room > 3 else []
            columns = (
                TextColumn("{task.description}"),
                *bar,
                TextColumn("{task.fields[figures]}"),
                TextColumn("left >" if self._least else "left"),
                TimeRemainingColumn(),
            )
            self._bar = Progress(*columns, console=self._console)
            self._bar.start()
            done, total = self._first.iteration, trainer.iterations
            self._task = self._bar.add_task(self._title, total=total, completed=done, figures="")

    def on_end(self, trainer: Training) -> None:  # noqa: ARG002
        """Leave the terminal as it was."""
        if self._bar is not None:
            self._bar.stop()

    def on_update(self, trainer: Training, row: Row) -> None:  # noqa: ARG002
        """Show the figures of the last evaluation."""
        at, aihtr = trainer.position, trainer.score.evaluation.aihtr
        # Of the time spent collecting: learners that replay go on for long after their last frame.
        speed = (at.frames - self._first.frames) / max(trainer.collecting, 1e-9)
        rate = f" {speed:,.0f}/s" if speed and self._console.width >= 100 else ""
        figures = f"{at.frames:,} frames{rate} AIHTR {aihtr:,.2f}"
        gap = trainer.evaluator.upper - aihtr
        if not math.isnan(gap):  # no upper bound is known on recorded tracks
            figures += f" gap {decimal(gap, 2)}"
        if self._bar is not None:
            self._bar.update(self._task, completed=at.iteration, figures=figures)
        elif not self._console.quiet:
            self._line(at.iteration, trainer.iterations, figures)

    def _line(self, iteration: int, iterations: int, figures: str) -> None:
        """A line after the first iteration, after the last, and every two seconds between."""
        now, first = time.monotonic(), self._first.iteration
        # The first line at once, so that a waiting user sees the speed; the last one, so that a log ends at 100 %.
        ends = iteration in (first + 1, iterations)
        if not ends and now - self._last_line < _SECONDS_BETWEEN_LINES:
            return
        self._last_line = now
        left = (now - self._started) / (iteration - first) * (iterations - iteration)
        least = "at least " if self._least and iteration < iterations else ""
        self._console.print(
            f"{self._title}: {100 * iteration // iterations:3d} %  {figures}  {least}{left:,.0f} s left"
        )


FIGURES = {
    "aihtr": "AIHTR",
    "accuracy": "accuracy",
    "sensors_per_step": "sensors per step",
    "safe_per_episode": "safe actions per episode",
    "expected_length": "steps per episode",
}
"""Figures of a policy as tables at the terminal have them."""
_HELD_OUT: tuple[tuple[Any, ...], ...] = (
    ("aihtr", "AIHTR", 2),
    ("reward_per_step", "reward per step", 4),
    ("accuracy", "accuracy", 2, 100.0, " %"),
    ("sensors_per_step", "sensors per step", 2),
)
"""Figures on held-out tracks, their names, and how `with_interval` shows them."""


@contextmanager
def reporting(console: Console, title: str) -> Iterator[Callable[[object], None]]:
    """Show a search as it goes on: one changing line at a terminal, a plain line now and then when piped.

    A scheduler's signals end it as Ctrl-C does, with its workers; by themselves they would end this process alone.

    Args:
        console: where.
        title: before each line, which is the text of a progress.
    """
    last = time.monotonic()
    ended = handled(stop, *ENDING)
    with ended, console.status(title) as status:

        def show(progress: object) -> None:
            nonlocal last
            line = f"{title}: {progress}"
            if console.is_terminal:
                status.update(line)
            elif time.monotonic() - last >= _SECONDS_BETWEEN_LINES:
                last = time.monotonic()
                console.print(line)

        yield show


def table(title: str, columns: list[str], rows: list[list[str]]) -> Table:
    """A table with its first column to the left and the others to the right."""
    first, *others = columns
    right = (Column(each, justify="right") for each in others)
    made = Table(first, *right, title=title, title_justify="left")
    for row in rows:
        made.add_row(*row)
    return made


def show_held_out(console: Console, subject: str, report: dict[str, Any]) -> None:
    """The figures of a policy beside those of the references, with their intervals."""
    rows = []
    # Figure by figure, policies under each other: side by side the intervals would be wider than 80 columns.
    for key, label, *form in _HELD_OUT:
        rows.append([label, ""])
        for name, figures in report["figures"].items():
            shown = with_interval(figures[key], *form)
            rows.append([f"  {subject if name == 'policy' else name}", shown])
    console.print(
        table(counted_words(report["tracks"], "held-out track"), ["", "mean (95 % interval)"], rows)
    )


def with_interval(
    interval: dict[str, float | None], digits: int, scale: float = 1.0, unit: str = ""
) -> str:
    """A mean with its interval in brackets."""
    known = [interval[key] for key in ("mean", "low", "high")]
    mean, low, high = ("–" if value is None else f"{scale * value:,.{digits}f}" for value in known)
    return f"{mean}{unit} ({low} ... {high})"
