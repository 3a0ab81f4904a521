"""Replay buffer of whole path segments, for targets whose motion is not Markov in the cell."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn.functional import pad

from trackmdp.algos.paths import CellIndex, cell_dtype, sensed_steps, stratified_starts

__all__ = ["SegmentBuffer"]


class SegmentBuffer:
    """Replay buffer of path segments: a located cell and the cells sensed in the `steps` steps after it, M for outside.

    Unlike `MoveBuffer` it never puts a path together from moves of different ones. A segment begins at every fully
    sensed step that is followed by enough others; which these are says nothing about where the target went.

    Args:
        num_cells: M.
        steps: steps of a segment.
        capacity: segments kept; the oldest go first.
        generator: draws the paths; the buffer lives on its device.
        weights: `[M + 1]`, by which each step to a cell multiplies what a segment counts; None: all count alike. See
            `report_weights`.
    """

    def __init__(
        self, num_cells: int, steps: int, capacity: int, generator: torch.Generator, weights: Tensor | None = None
    ) -> None:
        self.num_cells, self.steps, self._capacity, self._generator = num_cells, steps, capacity, generator
        self._weights = weights
        # Oldest first.
        self._segments = torch.empty(steps + 1, 0, dtype=cell_dtype(num_cells), device=generator.device)
        self._tail: dict[str, Tensor] = {}
        self._index: tuple[Tensor, CellIndex] | None = None

    def __len__(self) -> int:
        return self._segments.shape[1]

    def extend(self, batch: TensorDictBase) -> None:
        """Add the segments of a collected batch `[B, time]` or `[workers, B, time]`.

        Each row continues that of the batch before, so that segments may reach over the border between the two.
        """
        rows = _frames(batch.reshape(-1, batch.shape[-1]), self.num_cells)
        frames = {key: value.to(self._segments.device) for key, value in rows.items()}
        if self._tail and _goes_on(self._tail, frames):
            # Segments that began in the last steps - 1 frames of the batch before, and could not be completed there,
            # are now.
            frames = {key: torch.cat([self._tail[key], frames[key]], dim=1) for key in frames}
        fresh = _segments(frames, self.steps, self.num_cells)
        self._segments = torch.cat([self._segments, fresh], dim=1)[:, -self._capacity :].contiguous()
        # The frames at which a segment may begin that this batch is too short for.
        begin = max(0, frames["start"].shape[1] - self.steps + 1)
        self._tail = {key: value[:, begin:].clone() for key, value in frames.items()}
        self._index = None

    def moves(self) -> tuple[Tensor, Tensor]:
        """Cells before and after every move of every segment, int64 `[steps * K]` each; M after an exit."""
        return self._segments[:-1].long().flatten(), self._segments[1:].long().flatten()

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
        m = self.num_cells
        start, end = self._segments[:2].long()
        # Sorted by (start, end): with M = 4, the move 2 -> 3 has the key 2 * 5 + 3 = 13, and an exit from 2 the key 14.
        order = (start * (m + 1) + end).argsort(stable=True)
        segments = self._segments.index_select(1, order)
        weights = None if self._weights is None else self._weights[segments[1:].long()].prod(0)
        return pad(segments, (0, 1), value=m), CellIndex.of(start, m, weights)

    def state_dict(self) -> dict[str, Any]:
        """The segments, and the end of the last batch; the generator is its owner's to save."""
        return {"segments": self._segments, "tail": dict(self._tail)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a `state_dict`."""
        self._segments = state["segments"].to(self._segments)
        self._tail = {key: value.to(self._segments.device) for key, value in state["tail"].items()}
        self._index = None


def _frames(batch: TensorDictBase, num_cells: int) -> dict[str, Tensor]:
    """`[B, time]` of a collected batch: the cells around each step, whether it was sensed, whether it ended."""
    whole, end = sensed_steps(batch, num_cells)
    return {
        "start": batch["last_cell"].to(cell_dtype(num_cells)),
        "end": end.to(cell_dtype(num_cells)),
        "whole": whole,
        "done": batch["next", "done"].squeeze(-1),
    }


def _goes_on(before: dict[str, Tensor], frames: dict[str, Tensor]) -> bool:
    """Whether every row continues that of the batch before; not so where workers deliver in any order."""
    if not before["end"].shape[1] or len(before["end"]) != len(frames["start"]):
        return False
    # Only rows where both frames were sensed and the episode went on can be compared; the others prove nothing.
    same = before["end"][:, -1] == frames["start"][:, 0]
    known = before["whole"][:, -1] & frames["whole"][:, 0] & ~before["done"][:, -1]
    return bool((same | ~known).all())


def _segments(frames: dict[str, Tensor], steps: int, num_cells: int) -> Tensor:
    """`[steps + 1, K]`, the segments that are complete: fully sensed to their end or to the exit."""
    # 5 frames and segments of 3 steps: they may begin at frames 0, 1 and 2.
    count = frames["start"].shape[1] - steps + 1
    if count < 1:
        return frames["start"].new_empty(steps + 1, 0)
    cells = [frames["start"][:, :count]]
    complete = torch.ones_like(frames["whole"][:, :count])
    gone = ~complete
    for step in range(steps):
        end, whole, done = (frames[key][:, step : step + count] for key in ("end", "whole", "done"))
        # Once the target is gone, M fills the rest, and the frames there, of the next episode, are not asked about.
        complete = complete & (whole | gone)
        cells.append(torch.where(gone, num_cells, end))
        gone = gone | (end == num_cells)
        if step < steps - 1:
            # Done without an exit is a truncation: what follows belongs to another episode.
            complete = complete & (gone | ~done)
    return torch.stack(cells)[:, complete]
