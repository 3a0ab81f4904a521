"""Targets with a hidden mode: the next move depends on the cell and on a mode, such as a heading, that is not shown.

A hidden state is z = cell · H + mode, H modes in every cell. The tracker sees cells alone, so that what it knows at a
detection is what it remembers (`task.memory`), not the state.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import sparse

from trackmdp.errors import UserError
from trackmdp.world.checks import canonical_kernel, check_kernel
from trackmdp.world.model import Array, Size, Task, grid_size
from trackmdp.world.rows import pairwise_row_sums

__all__ = ["HiddenWorld", "heading_kernel"]

_HEADINGS = np.array([(0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1), (1, 0), (1, 1)])
"""Rows and columns of a step; 0 is to the right, and each of the eight turns left by 45 degrees."""


@dataclass(frozen=True, eq=False, init=False)
class HiddenWorld(Task):
    """A task together with the motion of a target whose mode is hidden.

    Args:
        kernel: `[M · H, M · H]` sub-stochastic, sparse or dense, on the hidden states z = cell · H + mode.
        modes: H.
        size: of the grid; further arguments are those of `Task`.

    Attributes:
        kernel: canonical CSR; row z sums to 1 - p_exit(z).
        modes: H.

    Raises:
        UserError: the kernel is none for this grid, or the safe action may miss.
    """

    kernel: sparse.csr_array
    modes: int

    def __init__(
        self, kernel: sparse.sparray | npt.NDArray[np.generic], size: Size, *, modes: int, **of_task: Any
    ) -> None:
        super().__init__(size, **(of_task | {"markov": False}))
        if not self.safe:
            raise UserError("kernel: with a hidden mode the safe action must not miss")
        if self.window is not None or self.max_steps is not None:
            raise UserError("kernel: with a hidden mode, expected grid.window=null and grid.max_steps=null")
        canonical = canonical_kernel(kernel)
        # As if every hidden state were a cell of a grid with H times as many columns.
        check_kernel(canonical, (self.rows, self.columns * modes), truncates=False)
        for name, value in (("kernel", canonical), ("modes", modes)):
            object.__setattr__(self, name, value)  # the dataclass is frozen

    @property
    def known(self) -> dict[str, Any]:
        """All that the task holds, as arguments of the constructor."""
        return self._known()

    @property
    def num_states(self) -> int:
        """M · H."""
        return self.num_cells * self.modes

    @property
    def stay_probability(self) -> Array:
        """`[M · H]` probability of still being in the grid after one step."""
        return pairwise_row_sums(self.kernel)


def heading_kernel(size: Size, *, keep: float, go: float, exit_probability: float) -> tuple[sparse.csr_array, int]:
    """Eight headings: kept with `keep`, else turned by 45 degrees to either side; then a step that way with `go`.

    At the border the target turns back: it stays in its cell, with the opposite heading. It leaves the grid from
    anywhere with `exit_probability`.

    Returns:
        The kernel on (cell, heading), and 8.
    """
    (rows, columns), modes = grid_size(size), len(_HEADINGS)
    states = np.arange(rows * columns * modes)
    cell, mode = np.divmod(states, modes)
    parts = []
    for turn, chance in ((0, keep), (1, (1.0 - keep) / 2), (-1, (1.0 - keep) / 2)):
        heading = (mode + turn) % modes
        row, column = cell // columns + _HEADINGS[heading, 0], cell % columns + _HEADINGS[heading, 1]
        free = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        ahead = np.where(free, (row * columns + column) * modes + heading, cell * modes + (heading + 4) % modes)
        still = cell * modes + heading
        for end, share in ((ahead, go), (still, 1.0 - go)):
            weight = np.full(len(states), (1.0 - exit_probability) * chance * share)
            parts.append(sparse.csr_array((weight, (states, end)), shape=(len(states), len(states))))
    return sparse.csr_array(sum(parts[1:], parts[0])), modes
