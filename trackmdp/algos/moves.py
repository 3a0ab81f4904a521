"""Replay buffer of sensed moves, and paths drawn from it, for targets whose motion is Markov in the cell.

And the common part of the buffers of sensed paths: which steps count, and how paths are drawn from each cell alike.
Where a policy knows more at a detection than the cell, paths are of keys: with all sensors on, a key contains the
target's cell and some of its past. All statements on cells and M hold for keys and their number.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from scipy import sparse
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn.functional import pad

from trackmdp.sensing.coverage import reported
from trackmdp.sensing.task import Task


def cell_dtype(num_cells: int) -> torch.dtype:
    """The smallest integers that hold all cells and M: 16 bits on grids of up to 181 x 181 cells."""
    return torch.int16 if num_cells <= torch.iinfo(torch.int16).max else torch.int32


class CellIndex(NamedTuple):
    """Row pointer of entries sorted by the cell they start in.

    Attributes:
        first: `[M + 1]` int64, place of the first entry of each cell; for a cell without entries, the place after all.
        share: `[M + 1]` float, number of entries of each cell, at least one, and slightly reduced (see `of`).
        sums: `[K + 1]` float64, running sums of the entries' weights, from 0 on; None where all weigh the same.
    """

    first: Tensor
    share: Tensor
    sums: Tensor | None = None

    @classmethod
    def of(cls, start: Tensor, num_cells: int, weights: Tensor | None = None) -> CellIndex:
        """Index entries `[K]` by the cells they start in; their `weights` `[K]` come in the order of the cells."""
        seen = torch.bincount(start, minlength=num_cells + 1)
        # Starts 0 0 2 on 3 cells: seen 2 0 1 0, first 0 3 2 3, the last one for M. A cell without entries leads to
        # place 3, where the buffers keep an exit.
        first = torch.where(seen > 0, seen.cumsum(0) - seen, len(start))
        # Half a float's spacing below the count, so that a draw close to 1 does not round up to the next cell's.
        share = seen.clamp(min=1).float() * (1.0 - 2.0**-24)
        return cls(
            first, share, None if weights is None else pad(weights.double().cumsum(0), (1, 0))
        )

    def pick(self, cells: Tensor, draws: Tensor) -> Tensor:
        """Places of entries of `cells`, one for each draw from [0, 1), in proportion to their weights."""
        if self.sums is not None:
            first = self.first.index_select(0, cells)
            # `ceil` undoes the reduction. A cell without entries has one place behind all of them, and keeps it.
            last = (first + self.share.index_select(0, cells).ceil().long()).clamp_max(
                len(self.sums) - 1
            )
            begin, end = self.sums[first], self.sums[last]
            place = torch.searchsorted(self.sums, begin + draws * (end - begin), right=True) - 1
            return torch.where(first < last, place.clamp(first, last - 1), first)
        return (draws * self.share.index_select(0, cells)).long() + self.first.index_select(
            0, cells
        )


def report_weights(task: Task, device: torch.device) -> Tensor | None:
    """`[M + 1]` 1 / p_d of a path's step to each cell (or key), 1 for the exit; None where no sensor misses.

    A path is known only where it was reported at every step, with probability Π p_d(x_k): weighted by the inverse of
    that, those known stand for all (Horvitz and Thompson 1952). Of footprints p_d is that of all sensors together.
    """
    if task.perfect:
        return None
    chance = task.detection
    if task.coverage is not None:
        every = sparse.csr_array(task.available[None].astype(np.float64))
        chance = reported(every, task.sees_by_cell.T.tocsr()).toarray()[0]
    weights = (1.0 / torch.as_tensor(chance, device=device)).repeat_interleave(
        task.keys.num_classes
    )
    return pad(weights, (0, 1), value=1.0)


def stratified_starts(
    count: int, steps: int, num_cells: int, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Cells `[count]` that paths start in, all equally often, and the draws `[steps, count]` that pick their moves.

    The draws of the first step are stratified: those of one cell are spread evenly over [0, 1).
    """
    device, m = generator.device, num_cells
    order = torch.arange(count, device=device)
    offset = torch.randint(m, (1,), generator=generator, device=device)
    draws = torch.rand(steps, count, generator=generator, device=device)
    # 10 paths on 4 cells: 3, 3, 2 and 2 of them start in cells 0, 1, 2 and 3 (up to the offset). The i-th of k draws
    # from [i/k, (i+1)/k).
    same_start = (m - 1 + count - order % m).div(m, rounding_mode="floor")
    draws[0] = (order // m + draws[0]) / same_start
    return (order + offset) % m, draws


def known_as(batch: TensorDictBase) -> str:
    """The name of a detection's record in a collected batch: `key` where there is one, else `last_cell`."""
    return "key" if "key" in batch.keys() else "last_cell"  # noqa: SIM118 (no dict)


def sensed_moves(batch: TensorDictBase, num_cells: int) -> tuple[Tensor, Tensor]:
    """Cells, or keys, before and after each of the steps of a collected batch `[B, time]` that count.

    Fully sensed steps of a located target count. Only observations are read: where the tracker located the target, and
    that it left the grid. Steps that did not sense every cell are passed over, also where they detected: to keep the
    detections alone would favour the sensed cells.

    Returns:
        Two int64 `[K]`; an end of M stands for outside.
    """
    name, after = known_as(batch), batch["next"]
    exited = after["terminated"].squeeze(-1)
    located = (after["steps_since_detection"] == 0) | exited
    # `every` is decided before the move, so that steps are not selected by where the target goes; with all sensors
    # on that there are, a step ends located or exited.
    # The least byte of each row: on 64 x 64 cells `all` takes ten times as long, counting a hundred times.
    every, there = batch["action"], batch.get("action_mask")
    every = every if there is None else every | ~there
    every = every.view(torch.uint8).amin(-1).bool()
    whole = every & (batch["steps_since_detection"] == 0) & located
    return batch[name][whole], torch.where(exited, num_cells, after[name])[whole]


class MoveBuffer:
    """Replay buffer of moves from a located cell to the cell sensed next, or to M, outside.

    A path drawn from it is put together: any move seen out of a cell may follow any arrival there, since the next move
    depends on the cell alone. So a path that is rare as a whole is still drawn as often as it should be.

    Args:
        task: its cells, or keys, and their `report_weights`, by which a move to each counts.
        capacity: moves kept; the oldest go first.
        generator: draws the paths; the buffer lives on its device.
    """

    def __init__(self, task: Task, capacity: int, generator: torch.Generator) -> None:
        self.num_cells, self._capacity, self._generator = task.num_keys, capacity, generator
        self._weights = report_weights(task, generator.device)
        # Oldest first, `[2, K]` each.
        self._parts = [torch.empty(2, 0, dtype=cell_dtype(self.num_cells), device=generator.device)]
        self._index: tuple[Tensor, CellIndex] | None = None

    def __len__(self) -> int:
        return min(self._seen, self._capacity)

    @property
    def _seen(self) -> int:
        return sum(part.shape[1] for part in self._parts)

    def extend(self, batch: TensorDictBase) -> None:
        """Add the moves sensed in a collected batch `[B, time]`."""
        self._parts.append(torch.stack(sensed_moves(batch, self.num_cells)).to(self._parts[0]))
        self._index = None
        # Twice as many as are kept: every move is then copied a few times at most, however long the run.
        if self._seen > 2 * self._capacity:
            self._kept()

    def _kept(self) -> Tensor:
        """`[2, K]`, all moves kept."""
        whole = torch.cat(self._parts, dim=1)[:, -self._capacity :].contiguous()
        self._parts = [whole]
        return whole

    def moves(self) -> tuple[Tensor, Tensor]:
        """Cells before and after every move, int64 `[K]` each."""
        start, end = self._kept().long()
        return start, end

    def paths(self, count: int, steps: int, generator: torch.Generator | None = None) -> Tensor:
        """`[steps + 1, count]` int64 cells of `count` paths, M from the exit on; every cell starts equally many.

        The first moves are stratified: out of each cell the paths leave in the proportions of the moves seen. They are
        drawn by the `generator`, or by the buffer's own.
        """
        ends, index = self._index = self._index or self._sort()
        start, draws = stratified_starts(count, steps, self.num_cells, generator or self._generator)
        cells = [start]
        for draw in draws:
            # M starts no move: its place is the entry behind all moves, which is M again.
            cells.append(ends.index_select(0, index.pick(cells[-1], draw)))
        return torch.stack(cells)

    def _sort(self) -> tuple[Tensor, CellIndex]:
        """All ends in the order of (start, end), and where those of each cell are.

        M leads to M, and so does a cell out of which no move was seen.
        """
        m = self.num_cells
        start, end = self.moves()
        # With M = 4, the move 2 -> 3 has the key 2 * 5 + 3 = 13, and 13 mod 5 = 3 gives its end back. One sort orders
        # the moves by start; that the ends of a start are sorted too makes stratified draws cover them in proportion.
        ends = (start * (m + 1) + end).sort().values % (m + 1)
        weights = None if self._weights is None else self._weights[ends]
        return torch.cat([ends, end.new_tensor([m])]), CellIndex.of(start, m, weights)

    def state_dict(self) -> dict[str, Any]:
        """The moves; the generator is its owner's to save."""
        return {"moves": self._kept()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a `state_dict`."""
        self._parts, self._index = [state["moves"].to(self._parts[0])], None
