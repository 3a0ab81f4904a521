"""A tracked target in plain text: some steps of one episode, with the sensors that are on."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from trackmdp.episodes.episode import Episode
from trackmdp.world.model import BoolArray, Task
from trackmdp.world.render import PICTURE_LEGEND, around, symbols

MARGIN = "   "
WIDE = 21
"""Rows and columns of a grid that are drawn at most."""


def draw_picture(episodes: Sequence[Episode], task: Task, *, steps: int = 6) -> str:
    """The first `steps` steps of an episode, side by side, under the legend.

    Of a grid larger than `WIDE` only the part around the target.

    Args:
        episodes: drawn is the first of them with so many steps in the grid, or the longest.
        task: where they took place.
        steps: frames drawn at most; fewer if the target exits before.
    """
    # Longer than `steps`: the picture is then full, and does not end with the exit.
    episode = next((each for each in episodes if len(each) > steps), None) or max(episodes, key=len)
    shown = list(_steps(episode, task, steps))
    way = np.divmod(np.array([cell for cell, _ in shown], dtype=np.int64), task.columns)
    # around the middle of its way
    middle = [(int(each.min()) + int(each.max())) // 2 if len(each) else 0 for each in way]
    rows, columns = (around(place, length, WIDE) for place, length in zip(middle, task.size, strict=True))
    part = slice(rows.start, rows.stop), slice(columns.start, columns.stop)
    frames = (symbols(task.size, cell, on, found=bool(on[cell]))[part] for cell, on in shown)
    pieces = [[f"step {k}", *map(" ".join, frame)] for k, frame in enumerate(frames, start=1)]
    wide = [[row.ljust(max(map(len, column))) for row in column] for column in pieces]
    lines = [MARGIN.join(parts) for parts in zip(*wide, strict=True)]
    whole = (len(rows), len(columns)) == task.size
    where = f"rows {rows[0]} to {rows[-1]} of {task.rows}, columns {columns[0]} to {columns[-1]} of {task.columns}"
    return "\n".join([*(line.rstrip() for line in lines), "", *([] if whole else [where]), PICTURE_LEGEND, ""])


def _steps(episode: Episode, task: Task, steps: int) -> Iterator[tuple[int, BoolArray]]:
    """The target's cell and the cells sensed, `[M]`, of each step in the grid; all of them where the safe action is."""
    forced = episode.forced(task.t_max)
    for t, cell in enumerate(episode.target[:steps].tolist()):
        # The cell numbered M stands for having left the grid.
        if cell < task.num_cells:
            yield cell, task.covered(episode.action[t]) | forced[t]
