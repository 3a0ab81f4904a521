"""Whole sensed paths, and the replay buffer of their segments, for motion that is not Markov in the cell."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn.functional import pad

from trackmdp.algos.moves import CellIndex, cell_dtype, report_weights, sensed_steps, stratified_starts
from trackmdp.solvers.path_exchange import parted
from trackmdp.world.model import Task
from trackmdp.world.tracks import Tracks, ends_of

_TELLING = 8
"""Cells at the end of a path that tell which recording it followed: wherever a path began, it ends as its recording."""


class SensedPaths:
    """Whole paths put together from batches, each row continuing the last.

    Only `sensed_steps` are read. A step that is none of them ends the path, and the next one begins another.

    Args:
        num_cells: M.
        capacity: sensed steps kept; the oldest go first; None for all.
    """

    def __init__(self, num_cells: int, capacity: int | None = None) -> None:
        self.num_cells, self._capacity, self._length = num_cells, capacity, 0
        # [3, rows, time] each: the cell before the step and the cell after it, M once outside, both -1 where it was not
        # sensed; and whether an episode ended with it.
        self._parts: list[Tensor] = []

    def __len__(self) -> int:
        return self._length

    def extend(self, batch: TensorDictBase) -> None:
        """Add a collected batch `[B, time]` or `[workers, B, time]`."""
        batch = batch.reshape(-1, batch.shape[-1])
        whole, end = sensed_steps(batch, self.num_cells)
        cells = (torch.where(whole, cell, -1) for cell in (batch["last_cell"], end))
        part = torch.stack([*cells, batch["next", "done"].squeeze(-1)]).to("cpu", cell_dtype(self.num_cells))
        if self._parts and not _goes_on(self._parts[-1], part):
            self._parts[-1][2, :, -1] = 1
        self._parts.append(part)
        self._length += int(whole.sum())
        if self._capacity is not None and self._length > self._capacity:
            self._forget(self._capacity)

    def _forget(self, capacity: int) -> None:
        """Drop the oldest steps, of all rows at once, until no more than `capacity` are left."""
        steps = torch.cat(self._parts, dim=2)
        later = (steps[0] >= 0).sum(0).flip(0).cumsum(0)
        columns = int((later <= capacity).sum())
        self._parts = [steps[:, :, steps.shape[2] - columns :].clone()]
        self._length = int(later[columns - 1]) if columns else 0

    def steps(self) -> Tensor:
        """`[2, K]` int64, the cells before and after all sensed steps; M after an exit."""
        before, after, _ = torch.cat(self._parts, dim=2).long()
        return torch.stack([before[before >= 0], after[before >= 0]])

    def tracks(self) -> Tracks:
        """All paths so far, those that still go on among them; they count as recordings that stop.

        Paths that end alike have one name: they are taken to follow one recording.
        """
        start, end, done = torch.cat(self._parts, dim=2).numpy().astype(np.int64)
        # A path begins where the step before was not sensed, or ended an episode.
        begins = np.ones(start.shape, dtype=bool)
        begins[:, 1:] = (start[:, :-1] < 0) | (done[:, :-1] > 0)
        kept = start >= 0
        start, end, begin = start[kept], end[kept], np.flatnonzero(begins[kept])
        # Steps 3>4 4>M (exit) and 7>8 become the cells 3 4 M 7 8: the first cell of each path, then where it went.
        cells = np.insert(end, begin, start[begin])
        inside = cells < self.num_cells
        path = np.cumsum(np.insert(np.zeros(len(end), dtype=np.int64), begin, 1)) - 1
        exits = np.zeros(len(begin), dtype=bool)
        exits[path[~inside]] = True
        cells, first = cells[inside], ends_of(np.bincount(path[inside], minlength=len(begin)))
        back = first[1:, None] - 1 - np.arange(_TELLING)
        ending = np.where(back >= first[:-1, None], cells[np.maximum(back, 0)], -1)
        names = np.unique(ending, axis=0, return_inverse=True)[1].ravel()
        return Tracks(cells, first, exits, names)

    def state_dict(self) -> dict[str, Tensor]:
        """The steps of all batches, end to end."""
        return {"steps": torch.cat(self._parts, dim=2)} if self._parts else {}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Continue from a `state_dict`."""
        self._parts = [part.cpu() for part in state.values()]
        self._length = sum(int((part[0] >= 0).sum()) for part in self._parts)


def _goes_on(before: Tensor, after: Tensor) -> bool:
    """Whether every row continues that of the batch before; not so where workers deliver in any order."""
    _, end, done = before[:, :, -1]
    start = after[0, :, 0]
    # Only rows where both steps were sensed and the episode went on can be compared; the others prove nothing.
    return bool(((end == start) | (end < 0) | (start < 0) | (done > 0)).all())


class SegmentBuffer:
    """Replay buffer of path segments: a located cell and the cells sensed in the `steps` steps after it, M for outside.

    Unlike `MoveBuffer` it never puts a path together from moves of different ones. A segment begins at every sensed
    step that is followed by enough others, or by the exit; which these are says nothing about where the target went.

    Args:
        task: its cells, and their `report_weights`, by which each step to a cell multiplies what a segment counts.
            Where a policy remembers detections, segments are of the keys with all sensors on.
        steps: steps of a segment.
        capacity: sensed steps kept; the oldest go first.
        generator: draws the paths; the index lives on its device.
        judge: seed by which recordings are kept from the segments, to judge what is learned by; None: none is.
    """

    def __init__(
        self, task: Task, steps: int, capacity: int, generator: torch.Generator, judge: int | None = None
    ) -> None:
        self.num_cells, self.steps, self.judge, self._generator = task.num_cells, steps, judge, generator
        self._weights, self._keys = report_weights(task, generator.device), task.keys if task.order else None
        self._outside = self._keys.num_keys if self._keys else task.num_cells
        self._paths = SensedPaths(task.num_cells, capacity)
        self._index: tuple[Tensor, CellIndex] | None = None

    def __len__(self) -> int:
        return len(self._paths)

    def extend(self, batch: TensorDictBase) -> None:
        """Add a collected batch, see `SensedPaths`."""
        self._paths.extend(batch)
        self._index = None

    def moves(self) -> tuple[Tensor, Tensor]:
        """Cells, or keys of them, before and after every sensed step, int64 `[K]` each; M after an exit."""
        start, end = self._paths.steps().to(self._generator.device) * (self._outside // self.num_cells)
        return start, end

    def tracks(self) -> Tracks:
        """All paths as a whole, those that judge among them."""
        return self._paths.tracks()

    def segments(self) -> Tensor:
        """`[steps + 1, K]`, in the order of the paths."""
        tracks = self.tracks() if self.judge is None else parted(self.tracks(), self.judge)[0]
        place, lengths = np.arange(len(tracks.cells)), tracks.lengths
        first, last = (np.repeat(ends, lengths) for ends in (tracks.first[:-1], tracks.first[1:] - 1))
        line, cells = tracks.cells, []
        if self._keys:
            # A key depends on the last detections alone: it is that of a path which began so many steps before.
            line = self._keys.start(tracks.cells[np.maximum(place - self._keys.order, first)])
            for back in range(self._keys.order - 1, -1, -1):
                following = self._keys.next(line, 0, tracks.cells[np.maximum(place - back, 0)])
                line = np.where(place - back > first, following, line)
        for step in range(self.steps + 1):
            gone = place + step > last
            cells.append(np.where(gone, self._outside, np.roll(line, -step)))
        whole = ~gone | np.repeat(tracks.exits, lengths)
        return torch.as_tensor(np.stack(cells)[:, whole]).to(self._generator.device, cell_dtype(self._outside))

    def sample(self, count: int) -> Tensor:
        """`[steps + 1, count]` int64, segments drawn as they are, each as likely as any other."""
        segments, _ = self._index = self._index or self._sort()
        drawn = torch.randint(segments.shape[1] - 1, (count,), generator=self._generator, device=segments.device)
        return segments.index_select(1, drawn).long()

    def paths(self, count: int, steps: int) -> Tensor:
        """`[steps + 1, count]` int64 cells of `count` paths, M from the exit on; every cell starts equally many.

        The first moves are stratified: out of each cell the paths leave in the proportions of the moves seen.
        """
        # Sorted at the first draw after an `extend`, not at every one.
        segments, index = self._index = self._index or self._sort()
        start, (draws,) = stratified_starts(count, 1, self.num_cells, self._generator)
        cells = segments[: steps + 1].index_select(1, index.pick(start, draws)).long()
        # Cells in which no segment begins were given the column of M alone; their paths leave at once.
        cells[0] = start
        return cells

    def _sort(self) -> tuple[Tensor, CellIndex]:
        """All segments in the order of their first moves, and where those of each cell are.

        One more, of M alone, stands for the cells in which no segment begins.
        """
        m, segments = self._outside, self.segments()
        start, end = segments[:2].long()
        # Sorted by (start, end): with M = 4, the move 2 -> 3 has the key 2 * 5 + 3 = 13, and an exit from 2 the key 14.
        order = (start * (m + 1) + end).argsort(stable=True)
        segments = segments.index_select(1, order)
        weights = None if self._weights is None else self._weights[segments[1:].long()].prod(0)
        return pad(segments, (0, 1), value=m), CellIndex.of(start, m, weights)

    def state_dict(self) -> dict[str, Any]:
        """The paths, and which of them judge; the generator is its owner's to save."""
        return {"judge": self.judge, "paths": self._paths.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a `state_dict`."""
        self.judge = state["judge"]
        self._paths.load_state_dict(state["paths"])
        self._index = None
