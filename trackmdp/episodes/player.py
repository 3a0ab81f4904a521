"""Episodes in plain text: played with keys at a terminal, step by step when piped, or as a picture of one."""

from __future__ import annotations

import math
import os
import select
import sys
import termios
import time
import tty
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from rich.console import Console
from rich.live import Live
from rich.text import Text

from trackmdp.arrays.types import IndexArray
from trackmdp.environment.render import (
    FOUND,
    FOUND_OF_SEVERAL,
    LEGEND_OF_SEVERAL,
    MISSED,
    ON,
    PICTURE_LEGEND,
    around,
    symbols,
)
from trackmdp.episodes.episode import Episode
from trackmdp.episodes.sentences import sentence
from trackmdp.sensing.task import Task

WIDE, STEP = 37, 9
"""Rows and columns of a grid that are drawn at most, which 80 characters hold, and how far the part drawn moves at
once: it stays where it is while the target does not leave 9 x 9 cells."""
_SHADES = " ·░▒▓"


def frame_legend(episode: Episode) -> str:
    """What the symbols of a frame mean."""
    found, missed = (
        FOUND_OF_SEVERAL
        if episode.several
        else (f"{FOUND} target, located", f"{MISSED} target, missed")
    )
    return f"{found}   {missed}   {ON} sensor on   ·░▒▓ where it was expected"


def frame(episode: Episode, t: int, task: Task) -> str:
    """The grid at a step, of a large one the part around the targets: they, over the sensors on, over the belief."""
    # digitize gives 0 below 1e-6, 1 below .05, ... 4 from .5 on: an index into the shades.
    levels = np.digitize(episode.expected(t), [1e-6, 0.05, 0.2, 0.5])
    on = task.covered(episode.action[t]) & ~episode.forced(task.t_max)[t]
    shades = np.array(list(_SHADES))[levels]
    marks = symbols(task.size, episode.target[t], on, found=episode.located[t], empty=shades)
    # Drawn around the targets, or around where they were before the last one left.
    before = episode.target[t - 1] if t else episode.start
    places = (np.atleast_1d(each) for each in (episode.target[t], before, episode.start))
    inside = (each[each < task.num_cells] for each in places)
    cells = next((each for each in inside if len(each)), np.atleast_1d(episode.start))
    parts = _parts(cells, task, WIDE, STEP)
    rows = [" ".join(row) for row in marks[np.ix_(*parts)]]
    edge = "─" * (2 * len(parts[1]) + 1)
    return "\n".join(
        [f"┌{edge}┐", *(f"│ {row} │" for row in rows), f"└{edge}┘", *_cut(task, parts)]
    )


def _parts(cells: IndexArray, task: Task, wide: int, step: int = 1) -> list[range]:
    """The rows and columns that are drawn of a large grid: around some cells, moved `step` at once."""
    sides = zip(np.divmod(cells, task.columns), task.size, strict=True)
    middles = ((int(way.min() + way.max()) // 2, length) for way, length in sides)
    return [around(at // step * step + step // 2, length, wide) for at, length in middles]


def _cut(task: Task, parts: Sequence[range]) -> list[str]:
    """The part that is drawn, in words, counted from 1; nothing where it is the whole grid."""
    if tuple(map(len, parts)) == task.size:
        return []
    cut = zip(("rows", "columns"), parts, task.size, strict=True)
    return [", ".join(f"{name} {part[0] + 1} to {part[-1] + 1} of {n}" for name, part, n in cut)]


KEYS = "space pause   ← → step   + - speed   home end   q quit"
_MOVES = {
    **dict.fromkeys(("l", "\x1b[C"), 1.0),
    **dict.fromkeys(("h", "\x1b[D"), -1.0),
    **dict.fromkeys(("0", "\x1b[H", "\x1b[1~"), -math.inf),
    **dict.fromkeys(("$", "\x1b[F", "\x1b[4~"), math.inf),
}
"""Key, a letter or an escape sequence -> how many steps it leads on, within the episode."""


@dataclass
class Playing:
    """Where the player is: step, speed (steps per second), whether it moves on by itself."""

    steps: int
    speed: float
    t: int = 0
    paused: bool = False
    over: bool = False

    def press(self, key: str) -> None:
        """Do the action of a key."""
        last = self.steps - 1
        if key == " ":
            self.paused = not self.paused
            if not self.paused and self.t == last:
                self.t = 0
        elif key in _MOVES:
            self.paused, self.t = True, int(min(max(self.t + _MOVES[key], 0), last))
        elif key in ("+", "-"):
            self.speed = min(max(self.speed * (2 if key == "+" else 0.5), 0.25), 256)
        elif key in ("q", "\x1b", "\x03"):
            self.over = True

    def tick(self) -> None:
        """Move on by one step; stay at the last, paused."""
        if self.paused:
            return
        self.t = min(self.t + 1, self.steps - 1)
        self.paused = self.t == self.steps - 1


def play(console: Console, episode: Episode, task: Task, speed: float) -> None:
    """Show an episode until it is quit, or all its steps as text where there is no terminal to play at."""
    if not (console.is_terminal and sys.stdin.isatty()):
        for t in range(len(episode)):
            console.print(f"{sentence(episode, t, task)}\n{frame(episode, t, task)}")
        console.print(frame_legend(episode))
        return
    state = Playing(len(episode), speed)
    with _keys() as descriptor, Live(console=console, auto_refresh=False, screen=True) as live:
        due = time.monotonic() + 1 / state.speed
        while not state.over:
            moves = "paused" if state.paused else f"{state.speed:g} steps/s"
            shown = f"{sentence(episode, state.t, task)}\n\n{frame(episode, state.t, task)}"
            shown += f"\n\n{frame_legend(episode)}\n{moves}   {KEYS}"
            live.update(Text(shown), refresh=True)
            key = _key(descriptor, max(0.0, due - time.monotonic()) if not state.paused else None)
            if key:
                state.press(key)
            if not key or key == " ":
                state.tick()
                due = time.monotonic() + 1 / state.speed


@contextmanager
def _keys() -> Iterator[int]:
    """Standard input without echo and without waiting for Enter; as it was afterwards."""
    descriptor = sys.stdin.fileno()
    before = termios.tcgetattr(descriptor)
    try:
        tty.setcbreak(descriptor)
        yield descriptor
    finally:
        termios.tcsetattr(descriptor, termios.TCSADRAIN, before)


def _key(descriptor: int, timeout: float | None) -> str:
    """The next key, escape sequences whole; empty after `timeout` seconds without one."""
    ready, _, _ = select.select([descriptor], [], [], timeout)
    # At most 8 bytes at once: an arrow key sends three (ESC [ C), and read one by one its first would count as ESC.
    return os.read(descriptor, 8).decode("utf-8", "replace") if ready else ""


PICTURE_WIDE = 21
"""Rows and columns of a grid that are drawn at most in each frame of a picture."""


def draw_picture(episodes: Sequence[Episode], task: Task, *, steps: int = 6) -> str:
    """The first `steps` steps of an episode, side by side, under the legend.

    Of a grid larger than `PICTURE_WIDE` only the part around the targets.

    Args:
        episodes: drawn is the first of them with so many steps in the grid, or the longest.
        task: where they took place.
        steps: frames drawn at most; fewer if all targets exit before.
    """
    # Longer than `steps`: the picture is then full, and does not end with the exit.
    episode = next((each for each in episodes if len(each) > steps), None) or max(episodes, key=len)
    target = episode.target[:steps].reshape(min(steps, len(episode)), -1)
    inside = target < task.num_cells
    cells = target[inside] if inside.any() else np.atleast_1d(episode.start)
    parts = _parts(cells, task, PICTURE_WIDE)
    columns, forced = [], episode.forced(task.t_max)
    for t in np.flatnonzero(inside.any(axis=1)).tolist():
        on = task.covered(episode.action[t]) | forced[t]
        marks = symbols(task.size, target[t], on, found=episode.located[t])[np.ix_(*parts)]
        column = [f"step {t + 1}", *map(" ".join, marks)]
        columns.append([row.ljust(max(map(len, column))) for row in column])
    lines = ["   ".join(row).rstrip() for row in zip(*columns, strict=True)]
    key = PICTURE_LEGEND if target.shape[1] == 1 else LEGEND_OF_SEVERAL
    return "\n".join([*lines, "", *_cut(task, parts), key, ""])
