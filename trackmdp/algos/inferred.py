"""Moves of a target that no sensor sees in some cells: those seen, and those that misses tell of, at their expectation.

With all sensors on, a miss says that the target is in one of the cells that none covers. The moves on such paths are
not known, but how often each was made is expected by expectation-maximisation (`KernelEstimate`), and paths put
together from expected moves are those of the kernel that explains what was seen.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from trackmdp.algos.common import arrays, tensors
from trackmdp.algos.learned_kernel import observed_paths
from trackmdp.algos.moves import CellIndex, MoveBuffer
from trackmdp.solvers.kernel_estimate import KernelEstimate
from trackmdp.solvers.renewal import row_index
from trackmdp.world.model import Task

_ROUNDS = 20
"""Rounds of expectation-maximisation, always from the moves seen at once: what a run learns from does not depend on
when it was asked."""


class InferredMoves(MoveBuffer):
    """A `MoveBuffer` whose moves are expected numbers of them; nothing is forgotten.

    Args:
        task: its sensors.
        generator: draws the paths; they come on its device.
    """

    def __init__(self, task: Task, generator: torch.Generator) -> None:
        super().__init__(task, 0, generator)
        self._task, self._estimate = task, KernelEstimate(task.size, weight=1.0, exit_weight=1.0)
        self._inferred: tuple[Tensor, Tensor, Tensor] | None = None

    def __len__(self) -> int:
        return len(self._estimate)

    def extend(self, batch: TensorDictBase) -> None:
        """Add the paths that end in a collected batch `[B, time]`, whatever was on."""
        self._estimate.add(observed_paths(batch, self._task))
        self._index = self._inferred = None

    def moves(self) -> tuple[Tensor, Tensor]:
        """Cells before and after every kind of move, int64 `[K]` each."""
        return self._infer()[:2]

    def counts(self) -> Tensor:
        """`[K]` float64, how many of each kind of `moves` there were."""
        return self._infer()[2]

    def _infer(self) -> tuple[Tensor, Tensor, Tensor]:
        if self._inferred is None:
            self._estimate.counts = self._estimate.direct
            self._estimate.fit(_ROUNDS)
            found = self._estimate.counts
            found.sort_indices()
            parts = (row_index(found), found.indices.astype("int64"), found.data)
            start, end, count = (torch.as_tensor(part, device=self._generator.device) for part in parts)
            self._inferred = start, end, count
        return self._inferred

    def _sort(self) -> tuple[Tensor, CellIndex]:
        """All ends in the order of (start, end), and where those of each cell are."""
        start, end, count = self._infer()
        return torch.cat([end, end.new_tensor([self.num_cells])]), CellIndex.of(start, self.num_cells, count)

    def state_dict(self) -> dict[str, Tensor]:
        """What was observed; the generator is its owner's to save."""
        return tensors(self._estimate.state())

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Continue from a `state_dict`."""
        self._estimate.load_state(arrays(state))
        self._index = self._inferred = None
