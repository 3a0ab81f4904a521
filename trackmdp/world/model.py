"""What a tracking task is, and the world it takes place in."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from scipy import sparse

from trackmdp.errors import UserError

__all__ = ["Array", "BoolArray", "Task", "World"]

Array: TypeAlias = npt.NDArray[np.float64]
BoolArray: TypeAlias = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Task:
    """What the tracker knows: the grid, the rewards, the costs and the safe-sensing limit, but not the motion.

    A learner is given a `Task`, never a `World`, so that it cannot read the kernel.

    Attributes:
        size: N, cells along one side of the grid.
        reward: r, earned when the target is sensed.
        cost: `[M]`, c per cell: the price of one sensor switched on for one step; M = N².
        safe_cost: D, the price of the safe action, forced after t_max + 1 misses in a row.
        t_max: T_max; the controller chooses freely at n = 0 ... t_max.
        markov: whether the next move depends on the target's cell alone, so that a learner may put paths together from
            moves seen on different ones.
        homogeneous: whether the target moves alike from all cells away from the border.
    """

    size: int
    reward: float
    cost: Array
    safe_cost: float
    t_max: int
    markov: bool = field(default=True, kw_only=True)
    homogeneous: bool = field(default=False, kw_only=True)

    def __post_init__(self) -> None:
        if self.cost.shape != (self.num_cells,):
            raise UserError(
                f"cost.sensor: expected one number or {self.num_cells} (one per cell), got shape {self.cost.shape}"
            )

    @property
    def num_cells(self) -> int:
        """M = N², the number of cells and of sensors."""
        return self.size**2

    @property
    def num_choices(self) -> int:
        """T_max + 1, the free choices between two forced ones."""
        return self.t_max + 1

    @property
    def task(self) -> Task:
        """The same task without the motion."""
        known = {"markov": self.markov, "homogeneous": self.homogeneous}
        return Task(self.size, self.reward, self.cost, self.safe_cost, self.t_max, **known)


@dataclass(frozen=True, eq=False)
class World(Task):
    """A task together with the target's motion (paper, Section II), which solvers may read and learners may not.

    Attributes:
        kernel: `[M, M]` sub-stochastic table P; row i sums to 1 - p_exit(i).
    """

    kernel: Array

    def __post_init__(self) -> None:
        super().__post_init__()
        m = self.num_cells
        if self.kernel.shape != (m, m):
            raise UserError(
                f"kernel: expected a {m}x{m} table for a {self.size}x{self.size} grid, got {self.kernel.shape}"
            )

    @cached_property
    def transition(self) -> sparse.csr_array:
        """The kernel as a sparse `[M, M]` matrix."""
        return sparse.csr_array(self.kernel)

    @cached_property
    def stay_probability(self) -> Array:
        """`[M]` probability of still being in the grid after one step, 1 - p_exit."""
        return self.kernel.sum(axis=1)
