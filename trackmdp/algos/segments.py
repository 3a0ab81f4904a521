"""Segments of sensed paths, and their replay buffer, for motion that is not Markov in the cell."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from trackmdp.algos.estimates.kernel_estimate import KernelEstimate
from trackmdp.algos.estimates.path_plans import parted
from trackmdp.algos.moves import CellIndex, MoveBuffer, cell_dtype
from trackmdp.algos.observed import EM_ROUNDS, SensedPaths, observed_paths
from trackmdp.arrays.entries import row_index
from trackmdp.sensing.task import Task


class SegmentBuffer(SensedPaths):
    """Replay buffer of path segments: a located cell and the cells sensed in the `steps` steps after it, M for outside.

    Unlike `MoveBuffer` it never puts a path together from moves of different ones. A segment begins at every step that
    is followed by enough others, or by the exit. Where none is followed by enough, each recording counts as if the
    target left where it stops.

    Args:
        task: its sensors. Where a policy remembers detections, segments are of the keys with all sensors on.
        steps: steps of a segment.
        capacity: steps kept, in whole batches; the oldest go first.
        generator: draws the paths; the index lives on its device.
        judge: seed by which recordings are kept from the segments, to judge the learned policies by; None: none.
    """

    def __init__(
        self,
        task: Task,
        steps: int,
        capacity: int,
        generator: torch.Generator,
        judge: int | None = None,
    ) -> None:
        super().__init__(task, capacity)
        self.steps, self.judge, self._generator, self._keys = steps, judge, generator, task.keys
        self._drawn_from: Tensor | None = None

    def extend(self, batch: TensorDictBase) -> None:
        """Add a collected batch, see `SensedPaths`."""
        super().extend(batch)
        self._drawn_from = None

    def moves(self) -> tuple[Tensor, Tensor]:
        """Cells, or keys of them, before and after every step, int64 `[K]` each; M after an exit."""
        start, end = (
            torch.as_tensor(part * self._keys.num_classes, device=self._generator.device)
            for part in self.tracks().steps(self._task.num_cells)
        )
        return start, end

    def segments(self) -> Tensor:
        """`[steps + 1, K]`, in the order of the paths."""
        tracks = self.tracks() if self.judge is None else parted(self.tracks(), self.judge)[0]
        place, lengths = np.arange(len(tracks.cells)), tracks.lengths
        first, last = (
            np.repeat(ends, lengths) for ends in (tracks.first[:-1], tracks.first[1:] - 1)
        )
        # A key depends on the last detections alone: it equals the key of a path that began so many steps before.
        keys, cells = self._keys, []
        line = keys.start(tracks.cells[np.maximum(place - keys.order, first)])
        for back in range(keys.order - 1, -1, -1):
            following = keys.next(line, 0, tracks.cells[np.maximum(place - back, 0)])
            line = np.where(place - back > first, following, line)
        for step in range(self.steps + 1):
            gone = place + step > last
            cells.append(np.where(gone, keys.num_keys, np.roll(line, -step)))
        whole = ~gone | np.repeat(tracks.exits, lengths)
        if gone.all():  # all recordings stop early; those of exits alone would be a selection: all count as exits
            whole |= last > place
        kind = cell_dtype(keys.num_keys)
        return torch.as_tensor(np.stack(cells)[:, whole]).to(self._generator.device, kind)

    def sample(self, count: int) -> Tensor:
        """`[steps + 1, count]` int64, segments drawn as they are, each as likely as any other."""
        if self._drawn_from is None:
            self._drawn_from = self.segments()
        segments, device = self._drawn_from, self._generator.device
        drawn = torch.randint(segments.shape[1], (count,), generator=self._generator, device=device)
        return segments.index_select(1, drawn).long()

    def state_dict(self) -> dict[str, Any]:
        """All that was observed, and what judges."""
        return {"judge": self.judge, "paths": super().state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a `state_dict`."""
        super().load_state_dict(state["paths"])
        self._drawn_from, self.judge = None, state["judge"]


class InferredMoves(MoveBuffer):
    """A `MoveBuffer` of expected moves, given all paths from detection to detection; for cells that no sensor covers.

    Args:
        task: its cells, or keys where a detection reveals the mode, and its sensors.
        generator: draws the paths; they come on its device.
    """

    def __init__(self, task: Task, generator: torch.Generator) -> None:
        super().__init__(task, 0, generator)
        self._task, modes = task, task.keys.num_classes
        # A mode that is revealed moves on its own; else cells are alike where the moves seen show no difference.
        share = False if modes > 1 else None
        self._estimate = KernelEstimate(
            task.size, weight=1.0, exit_weight=1.0, share_cells=share, modes=modes
        )

    def __len__(self) -> int:
        return len(self._estimate)

    def extend(self, batch: TensorDictBase) -> None:
        """Add the paths that end in a collected batch `[B, time]`, with any sensors on."""
        self._estimate.add(observed_paths(batch, self._task))
        self._index = None

    def moves(self) -> tuple[Tensor, Tensor]:
        """Cells before and after every move that may have been made, int64 `[K]` each."""
        self._index = self._index or self._sort()
        start, end, _ = self._counts()
        return start, end

    def _counts(self) -> tuple[Tensor, ...]:
        """Starts, ends and numbers of the expected moves."""
        counts, device = self._estimate.counts, self._generator.device
        parts = (row_index(counts), counts.indices.astype(np.int64), counts.data)
        return tuple(torch.as_tensor(part, device=device) for part in parts)

    def _sort(self) -> tuple[Tensor, CellIndex]:
        """All ends in the order of (start, end), and where those of each cell are, weighted by expected numbers."""
        estimate = self._estimate
        # From the moves seen alone: the result does not depend on when it was asked for before.
        estimate.counts = estimate.direct
        estimate.fit(EM_ROUNDS)
        estimate.counts.sort_indices()
        start, end, weights = self._counts()
        ends = torch.cat([end, end.new_tensor([self.num_cells])])
        return ends, CellIndex.of(start, self.num_cells, weights)

    def state_dict(self) -> dict[str, Any]:
        """All that was observed."""
        return self._estimate.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a `state_dict`."""
        self._estimate.load_state_dict(state)
        self._index = None
