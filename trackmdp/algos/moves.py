"""What the tracker has seen of the target's motion: a replay buffer of sensed moves, and paths drawn from it."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

__all__ = ["MoveBuffer", "sensed_moves"]


class MoveBuffer:
    """Replay buffer of moves from a located cell to the cell sensed next, or to M, outside.

    A path drawn from it is put together: any move seen out of a cell may follow any arrival there, since the next move
    depends on the cell alone. So a path that is rare as a whole is still drawn as often as it should be.

    Args:
        num_cells: M.
        capacity: moves kept; the oldest go first.
        generator: draws the paths; the buffer lives on its device.
    """

    def __init__(self, num_cells: int, capacity: int, generator: torch.Generator) -> None:
        self.num_cells, self._capacity, self._generator = num_cells, capacity, generator
        # Oldest first; no grid has more cells than 16 bits count.
        self._moves = torch.empty(2, 0, dtype=torch.int16, device=generator.device)
        self._index: tuple[Tensor, Tensor, Tensor] | None = None

    def __len__(self) -> int:
        return self._moves.shape[1]

    def extend(self, batch: TensorDictBase) -> None:
        """Add the moves sensed in a collected batch `[B, time]`."""
        fresh = torch.stack(sensed_moves(batch, self.num_cells)).to(self._moves)
        self._moves = torch.cat([self._moves, fresh], dim=1)[:, -self._capacity :].contiguous()
        self._index = None

    def moves(self) -> tuple[Tensor, Tensor]:
        """Cells before and after every move, int64 `[K]` each."""
        start, end = self._moves.long()
        return start, end

    def paths(self, count: int, steps: int) -> Tensor:
        """`[steps + 1, count]` int64 cells of `count` paths, M from the exit on; every cell starts equally many.

        The first moves are stratified: out of each cell the paths leave in the proportions of the moves seen.
        """
        ends, first, seen = self._index = self._index or self._sort()
        device, m = ends.device, self.num_cells
        order = torch.arange(count, device=device)
        offset = torch.randint(m, (1,), generator=self._generator, device=device)
        draws = torch.rand(steps, count, generator=self._generator, device=device)
        same_start = (m - 1 + count - order % m).div(m, rounding_mode="floor")
        draws[0] = (order // m + draws[0]) / same_start
        cells = [(order + offset) % m]
        for share in draws:
            at = cells[-1]
            chosen = (share * seen.index_select(0, at)).long() + first.index_select(0, at)
            cells.append(ends.index_select(0, chosen))
        return torch.stack(cells)

    def _sort(self) -> tuple[Tensor, Tensor, Tensor]:
        """All ends in the order of (start, end), and per cell where its own begin and how many they are.

        M leads to M, and so does a cell out of which no move was seen.
        """
        m = self.num_cells
        start, end = self.moves()
        ends = torch.cat([(start * (m + 1) + end).sort().values % (m + 1), end.new_tensor([m])])
        seen = torch.bincount(start, minlength=m + 1)
        first = torch.where(seen > 0, seen.cumsum(0) - seen, len(start))
        # Half a float's spacing below the count, so that a draw close to 1 does not round up to the next cell's moves.
        return ends, first, seen.clamp(min=1).float() * (1.0 - 2.0**-24)

    def state_dict(self) -> dict[str, Tensor]:
        """The moves; the generator is its owner's to save."""
        return {"moves": self._moves}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Continue from a `state_dict`."""
        self._moves, self._index = state["moves"].to(self._moves), None


def sensed_moves(batch: TensorDictBase, num_cells: int) -> tuple[Tensor, Tensor]:
    """Cells before and after each fully sensed step of a located target, in a collected batch `[B, time]`.

    Read is only what the tracker saw: where it located the target, and that it left the grid. Steps that did not sense
    every cell are passed over, also where they detected: to keep the detections alone would favour the sensed cells.

    Returns:
        Two int64 `[K]`; an end of M stands for outside.
    """
    after = batch["next"]
    exited = after["terminated"].squeeze(-1)
    located = (after["steps_since_detection"] == 0) | exited
    whole = batch["action"].all(-1) & (batch["steps_since_detection"] == 0) & located
    end = torch.where(exited, num_cells, after["last_cell"])
    return batch["last_cell"][whole], end[whole]
