"""Replay buffer of sensed moves, and paths drawn from it, for targets whose motion is Markov in the cell."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from trackmdp.algos.paths import CellIndex, cell_dtype, known_as, sensed_steps, stratified_starts


class MoveBuffer:
    """Replay buffer of moves from a located cell to the cell sensed next, or to M, outside.

    A path drawn from it is put together: any move seen out of a cell may follow any arrival there, since the next move
    depends on the cell alone. So a path that is rare as a whole is still drawn as often as it should be.

    Args:
        num_cells: M.
        capacity: moves kept; the oldest go first.
        generator: draws the paths; the buffer lives on its device.
        weights: `[M + 1]`, how much a move to each cell counts; None: all alike. See `report_weights`.
    """

    def __init__(
        self, num_cells: int, capacity: int, generator: torch.Generator, weights: Tensor | None = None
    ) -> None:
        self.num_cells, self._capacity, self._generator, self._weights = num_cells, capacity, generator, weights
        # Oldest first; those of the last batches wait to be appended, which copies all that is there.
        self._moves = torch.empty(2, 0, dtype=cell_dtype(num_cells), device=generator.device)
        self._fresh: list[Tensor] = []
        self._index: tuple[Tensor, CellIndex] | None = None

    def __len__(self) -> int:
        return min(self._moves.shape[1] + self._waiting, self._capacity)

    def extend(self, batch: TensorDictBase) -> None:
        """Add the moves sensed in a collected batch `[B, time]`."""
        self._fresh.append(torch.stack(sensed_moves(batch, self.num_cells)).to(self._moves))
        self._index = None
        # As many waiting as appended: every move is then copied a few times at most, however long the run.
        if self._waiting > self._moves.shape[1]:
            self._appended()

    @property
    def _waiting(self) -> int:
        return sum(part.shape[1] for part in self._fresh)

    def _appended(self) -> Tensor:
        """`[2, K]`, all moves kept."""
        if self._fresh:
            self._moves = torch.cat([self._moves, *self._fresh], dim=1)[:, -self._capacity :].contiguous()
            self._fresh = []
        return self._moves

    def moves(self) -> tuple[Tensor, Tensor]:
        """Cells before and after every move, int64 `[K]` each."""
        start, end = self._appended().long()
        return start, end

    def counts(self) -> Tensor | None:
        """`[K]`, how many each of `moves` stands for; None: each was seen."""
        return None

    def paths(self, count: int, steps: int) -> Tensor:
        """`[steps + 1, count]` int64 cells of `count` paths, M from the exit on; every cell starts equally many.

        The first moves are stratified: out of each cell the paths leave in the proportions of the moves seen.
        """
        ends, index = self._index = self._index or self._sort()
        start, draws = stratified_starts(count, steps, self.num_cells, self._generator)
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

    def state_dict(self) -> dict[str, Tensor]:
        """The moves; the generator is its owner's to save."""
        return {"moves": self._appended()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Continue from a `state_dict`."""
        self._moves, self._fresh, self._index = state["moves"].to(self._moves), [], None


def sensed_moves(batch: TensorDictBase, num_cells: int) -> tuple[Tensor, Tensor]:
    """Cells before and after each of the `sensed_steps` of a collected batch `[B, time]`.

    Returns:
        Two int64 `[K]`; an end of M stands for outside.
    """
    name = known_as(batch)
    whole, end = sensed_steps(batch, num_cells, name)
    return batch[name][whole], end[whole]
