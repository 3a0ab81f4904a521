"""A tracked target in plain text: some steps of one episode, with the sensors that are on."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from trackmdp.episodes.episode import Episode
from trackmdp.world.model import BoolArray, Task
from trackmdp.world.render import PICTURE_LEGEND, text_rows

__all__ = ["draw_picture"]

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
    frames = [text_rows(task.size, cell, on, found=bool(on[cell])) for cell, on in _steps(episode, task, steps)]
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
