"""The world: a task together with the motion of its target."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Unpack

import numpy as np
import numpy.typing as npt
from scipy import sparse

from trackmdp.arrays.numbers import whole_number
from trackmdp.arrays.types import Array
from trackmdp.errors import UserError
from trackmdp.grid.displacements import displacement
from trackmdp.grid.size import Size
from trackmdp.motion.chain import Motion
from trackmdp.motion.kernel_checks import canonical_kernel, check_kernel
from trackmdp.notebook.card import Facts
from trackmdp.sensing.task import Task, TaskOptions


@dataclass(frozen=True, eq=False, init=False, repr=False)
class World(Task):
    """A task together with the target's motion (paper, Section II), which solvers may read and learners may not.

    The target has a hidden state z = cell · modes + mode. With one mode, the default, the state is the cell.

    Args:
        kernel: `[Z, Z]` table of P, sparse or dense, Z = M · modes.
        size: N of an N x N grid, or (rows, columns).
        modes: H, modes of the target in each cell, such as headings or regimes.
        reveals: whether a detection reveals the mode as well (Doppler, AIS).
        **of_task: `cost`, always needed; `t_max`, `safe_cost`, `reward`, `max_steps`, `window`, `budget`, `detection`,
            `safe_detection`, `coverage`, `memory`, `clip`, `place`: attributes of `trackmdp.sensing.task.Task`.

    Attributes:
        kernel: `[Z, Z]` canonical CSR matrix of float64, without explicit zeros; row z sums to 1 - p_exit(z).
        modes: H.

    Raises:
        UserError: `kernel` is no sub-stochastic table for this grid, or without `max_steps` some cell has no way out.
    """

    kernel: sparse.csr_array
    modes: int

    def __init__(
        self,
        kernel: sparse.sparray | sparse.spmatrix | npt.NDArray[np.generic],
        size: Size,
        *,
        modes: int = 1,
        reveals: bool = False,
        **of_task: Unpack[TaskOptions],
    ) -> None:
        modes = whole_number("modes", modes, 1)
        known = modes if reveals else of_task.get("revealed", 1)
        if known not in (1, modes):
            raise UserError(f"revealed={known}: expected 1 or {modes}, the modes of the target")
        own = {"revealed": known} | ({"markov": known == modes} if modes > 1 else {})
        super().__init__(size, **(of_task | own))  # type: ignore[arg-type]  # which makes arrays of them
        # Checked in canonical form: duplicates are added up and zeros dropped, as solvers will see it.
        canonical = canonical_kernel(kernel)
        # As if every hidden state were a cell of a grid with H times as many columns.
        shape = (self.rows, self.columns * modes)
        check_kernel(canonical, shape, truncates=self.max_steps is not None, modes=modes)
        object.__setattr__(self, "kernel", canonical)  # the dataclass is frozen
        object.__setattr__(self, "modes", modes)

    @classmethod
    def of(
        cls, task: Task, kernel: sparse.sparray | npt.NDArray[np.generic], **changes: Any
    ) -> World:
        """The world of a task with a `kernel` `[Z, Z]`; `changes` are arguments that differ from the task's."""
        return cls(kernel, **(task.given | changes))

    def but(self, **changes: Any) -> World:
        """The same motion in a task that differs in `changes`."""
        return World(self.kernel, modes=self.modes, **(self.given | changes))

    def facts(self) -> Facts:
        """The figures of the card, those of the motion among them."""
        if self.modes == 1:
            return super().facts() | {"motion": motion_words(self.kernel, "cell")}
        shown = "shown by a detection" if self.revealed > 1 else "hidden"
        motion = motion_words(self.kernel, "state")
        return super().facts() | {"motion": motion, "modes": f"{self.modes}, {shown}"}

    @property
    def model(self) -> World:
        """The world itself; of recorded tracks None."""
        return self

    @property
    def recorded(self) -> None:
        """None; of recorded tracks the tracks."""

    @property
    def selection(self) -> World:
        """The problem that learning evaluates on: of recorded tracks the validation part."""
        return self

    @property
    def tells_all(self) -> bool:
        """Whether a detection reveals the whole state: there is one mode, or it is shown."""
        return self.revealed == self.modes

    @property
    def num_states(self) -> int:
        """Z = M · H."""
        return self.num_cells * self.modes

    @cached_property
    def motion(self) -> Motion:
        """The target as a chain of hidden states."""
        return Motion.of(self.kernel, self.modes)

    def sampled(self, *, held_out: bool = False) -> Motion:  # noqa: ARG002
        """The chain that targets are drawn from, the same in training and evaluation."""
        return self.motion

    @cached_property
    def drift(self) -> Array:
        """`[H, 2]` mean rows and columns of a step in each mode, over all cells alike: the look of a mode."""
        moves = self.kernel.tocoo()
        before, (cell, mode) = moves.row // self.modes, np.divmod(moves.col, self.modes)
        steps = displacement(self.columns, before, cell)
        weight = np.maximum(np.bincount(mode, moves.data, self.modes), 1e-300)
        return np.stack(
            [np.bincount(mode, moves.data * step, self.modes) / weight for step in steps], axis=1
        )

    @property
    def stay_probability(self) -> Array:
        """`[Z]` probability of still being in the grid after one step, 1 - p_exit."""
        return self.motion.stay


def motion_words(kernel: sparse.csr_array, state: str) -> str:
    """Successors of a state and the probability of leaving the grid, averaged over all rows of `kernel`."""
    rows = kernel.shape[0]
    left = max(0.0, 1.0 - float(kernel.sum()) / rows)
    return f"{kernel.nnz / rows:.3g} successors per {state}, exit probability {left:.3g} (means)"
