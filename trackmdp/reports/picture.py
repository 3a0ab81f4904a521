"""A tracked target in plain text: some steps of one episode, with the sensors that are on."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from trackmdp.episodes.episode import Episode
from trackmdp.world.model import BoolArray, Task

__all__ = ["PICTURE_LEGEND", "draw_picture"]

FOUND, MISSED, ON, OFF = "●", "○", "▪", "·"
PICTURE_LEGEND = f"{FOUND} target, detected   {MISSED} target, missed   {ON} sensor on   {OFF} sensor off"
MARGIN = "   "


def draw_picture(episodes: Sequence[Episode], task: Task, *, steps: int = 6) -> str:
    """The first `steps` steps of an episode, side by side, under the legend.

    Args:
        episodes: drawn is the first of them with so many steps in the grid, or the longest.
        task: where they took place.
        steps: frames drawn at most; fewer if the target exits before.
    """
    # Longer than `steps`: the picture is then full, and does not end with the exit.
    episode = next((each for each in episodes if len(each) > steps), None) or max(episodes, key=len)
    frames = [_frame(task, cell, on) for cell, on in _steps(episode, task, steps)]
    columns = [[f"step {k}", *frame] for k, frame in enumerate(frames, start=1)]
    wide = [[row.ljust(max(map(len, column))) for row in column] for column in columns]
    lines = [MARGIN.join(rows) for rows in zip(*wide, strict=True)]
    return "\n".join([*(line.rstrip() for line in lines), "", PICTURE_LEGEND, ""])


def _steps(episode: Episode, task: Task, steps: int) -> Iterator[tuple[int, BoolArray]]:
    """The target's cell and the sensors on, `[M]`, of each step in the grid; all of them where the safe action is."""
    forced = episode.forced(task.t_max)
    for t, cell in enumerate(episode.target[:steps].tolist()):
        # The cell numbered M stands for having left the grid.
        if cell < task.num_cells:
            yield cell, episode.action[t] | forced[t]


def _frame(task: Task, cell: int, on: BoolArray) -> list[str]:
    marks = np.where(on, ON, OFF)
    marks[cell] = FOUND if on[cell] else MISSED
    return [" ".join(row) for row in marks.reshape(task.size)]
