"""A tracked target in plain text: some steps of one episode, with the sensors that are on."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from trackmdp.seeding import derive
from trackmdp.world.model import BoolArray, World
from trackmdp.world.tracks import Problem

__all__ = ["LEGEND", "draw"]

FOUND, MISSED, ON, OFF = "●", "○", "▪", "·"
LEGEND = f"{FOUND} target, detected   {MISSED} target, missed   {ON} sensor on   {OFF} sensor off"
MARGIN = "   "


def draw(world: Problem, chains: npt.NDArray[np.generic], *, seed: int, steps: int = 6) -> str:
    """The first `steps` steps of an episode from the middle of the grid, side by side, under the legend.

    Args:
        world: its kernel moves the target; without one, it goes along one of the held-out tracks from its start.
        chains: `[M, t_max+1, M]` sensors switched on; a probability counts as on from 1/2.
        seed: of the target's path, stream ``"picture"``.
        steps: frames drawn at most; fewer if the target exits before.
    """
    sensed = np.asarray(chains, dtype=float) >= 0.5
    frames = [_frame(world, *step) for step in _episode(world, sensed, seed, steps)]
    columns = [[f"step {k}", *frame] for k, frame in enumerate(frames, start=1)]
    wide = [[row.ljust(max(map(len, column))) for row in column] for column in columns]
    lines = [MARGIN.join(rows) for rows in zip(*wide, strict=True)]
    return "\n".join([*(line.rstrip() for line in lines), "", LEGEND, ""])


def _episode(world: Problem, sensed: BoolArray, seed: int, steps: int) -> list[tuple[int, BoolArray]]:
    """The target's cell and the sensors `[M]` of each step, the exit step left out."""
    last, *path = _path(world, seed, steps)
    misses, frames = 0, []
    for cell in path:
        on = sensed[last, misses] if misses <= world.t_max else np.ones(world.num_cells, dtype=bool)
        frames.append((cell, on))
        last, misses = (cell, 0) if on[cell] else (last, misses + 1)
    return frames


def _path(world: Problem, seed: int, steps: int) -> list[int]:
    """The cell in which the target starts, and those of at most `steps` steps."""
    rng = np.random.default_rng(derive(seed, "picture"))
    if not isinstance(world, World):
        tracks = world.held_out
        chosen = int(rng.integers(len(tracks)))
        begin, end = tracks.first[chosen : chosen + 2]
        return [int(cell) for cell in tracks.cells[begin : min(end, begin + steps + 1)]]
    path = [world.rows // 2 * world.columns + world.columns // 2]
    while len(path) <= steps:
        row = world.kernel[[path[-1]]].toarray()[0]
        cell = int(rng.choice(world.num_cells + 1, p=[*row, max(0.0, 1.0 - row.sum())]))
        if cell == world.num_cells:
            break
        path.append(cell)
    return path


def _frame(world: Problem, cell: int, on: BoolArray) -> list[str]:
    marks = np.where(on, ON, OFF)
    marks[cell] = FOUND if on[cell] else MISSED
    return [" ".join(row) for row in marks.reshape(world.size)]
