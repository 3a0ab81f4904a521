"""What a world is: a target's motion and the price of watching it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from scipy import sparse

from trackmdp.errors import UserError

__all__ = ["Array", "BoolArray", "World"]

Array: TypeAlias = npt.NDArray[np.float64]
BoolArray: TypeAlias = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class World:
    """The tracking problem (paper, Section II): target kernel, rewards, costs and the safe-sensing limit.

    Attributes:
        size: N, cells along one side of the grid.
        kernel: `[M, M]` sub-stochastic table P, M = N²; row i sums to 1 - p_exit(i).
        reward: r, earned when the target is sensed.
        cost: `[M]`, c per cell: the price of one sensor switched on for one step.
        safe_cost: D, the price of the safe action, forced after t_max + 1 misses in a row.
        t_max: T_max; the controller chooses freely at n = 0 ... t_max.
    """

    size: int
    kernel: Array
    reward: float
    cost: Array
    safe_cost: float
    t_max: int

    def __post_init__(self) -> None:
        m = self.size**2
        if self.kernel.shape != (m, m):
            raise UserError(
                f"kernel: expected a {m}x{m} table for a {self.size}x{self.size} grid, got {self.kernel.shape}"
            )
        if self.cost.shape != (m,):
            raise UserError(f"cost.sensor: expected one number or {m} numbers (one per cell), got {self.cost.shape}")

    @property
    def num_cells(self) -> int:
        """M = N², the number of cells and of sensors."""
        return self.size**2

    @property
    def num_choices(self) -> int:
        """T_max + 1, the free choices between two forced ones."""
        return self.t_max + 1

    @cached_property
    def transition(self) -> sparse.csr_array:
        """The kernel as a sparse `[M, M]` matrix."""
        return sparse.csr_array(self.kernel)

    @cached_property
    def stay_probability(self) -> Array:
        """`[M]` probability of still being in the grid after one step, 1 - p_exit."""
        return self.kernel.sum(axis=1)
