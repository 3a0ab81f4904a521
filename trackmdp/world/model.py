"""What a tracking task is, and the world it takes place in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from functools import cached_property
from typing import Any, Required, TypeAlias, TypedDict, Unpack

import numpy as np
import numpy.typing as npt
from scipy import sparse

from trackmdp.config.sensing import LARGEST_PRICE
from trackmdp.config.world import MEMORIES
from trackmdp.errors import UserError
from trackmdp.world.checks import PRICES, PROBABILITIES, canonical_kernel, check_kernel, one_each
from trackmdp.world.coverage import Coverage
from trackmdp.world.memory import KeySpace
from trackmdp.world.rows import pairwise_row_sums

Array: TypeAlias = npt.NDArray[np.float64]
BoolArray: TypeAlias = npt.NDArray[np.bool_]

Size: TypeAlias = int | Sequence[int]
"""Size of a grid as a user gives it: one number for a square, or rows and columns."""


class TaskOptions(TypedDict, total=False):
    """What the constructors of `World`, `HiddenWorld` and `Recorded` hand on to that of `Task`."""

    cost: Required[npt.ArrayLike]
    t_max: Required[int]
    safe_cost: float | None
    reward: float
    max_steps: int | None
    window: int | None
    detection: npt.ArrayLike
    safe_detection: npt.ArrayLike
    coverage: Any
    markov: bool
    memory: str
    clip: int
    revealed: int


_NULLABLE = ("max_steps", "window")
_GIVEN: Any = 1.0
_SUM: Any = None
"""Defaults of a task that its constructor makes arrays and a price of."""


@dataclass(frozen=True, eq=False)
class Task:
    """What the tracker knows: the grid, the rewards, the costs and the limits, but not the motion.

    A learner is given a `Task`, never a `World`, so that it cannot read the kernel. Cells are numbered row by row: the
    cell in row i and column j is i · columns + j.

    Attributes:
        size: (rows, columns) of the grid; the constructor takes one number for a square grid.
        cost: `[S]`, c: the price of each sensor switched on for one step; the constructor takes one number for all.
        t_max: T_max; the controller chooses freely at n = 0 ... t_max.
        safe_cost: D, the price of the safe action, forced after t_max + 1 misses in a row; default: the sum of `cost`.
        reward: r, earned when the target is sensed.
        max_steps: episodes are truncated after this many steps; None for never.
        window: W; only the sensors up to W rows and columns from the last located cell can be chosen. None: all can.
        detection: `[M]`, p_d per cell, in (0, 1]: how likely a sensor that is on reports the target in its cell; the
            constructor takes one number for all cells.
        safe_detection: `[M]`, p_s per cell, in (0, 1]: the same of the safe action; below 1 it is repeated, at D each,
            until it locates the target.
        coverage: the cells that each of the S sensors covers, where that is not its own cell alone; the constructor
            takes a table or sparse matrix `[S, M]` of 0 and 1. None: S = M, sensor s covers cell s.
        markov: whether the next move depends on what a detection tells alone, the cell or, where it does, cell and
            mode, so that a learner may put paths together from moves seen on different ones.
        memory: what a policy remembers at a detection, one of `trackmdp.config.world.MEMORIES`; see `KeySpace`.
        clip: rows and columns up to which remembered displacements are told apart.
        revealed: modes of the target that a detection tells apart; 1 where it tells the cell alone.

    Raises:
        UserError: a number is out of its range, `cost` does not have one price per sensor, or footprints go together
            with a window, with sensors that miss, or with a memory of more than the cell.
    """

    size: tuple[int, int]
    _: KW_ONLY
    cost: Array
    t_max: int
    safe_cost: float = _SUM
    reward: float = 1.0
    max_steps: int | None = None
    window: int | None = None
    detection: Array = _GIVEN
    safe_detection: Array = _GIVEN
    coverage: Coverage | None = None
    markov: bool = True
    memory: str = "cell"
    clip: int = 2
    revealed: int = 1

    def __post_init__(self) -> None:
        if self.memory not in MEMORIES:
            raise UserError(f"memory={self.memory}: expected one of {', '.join(MEMORIES)}")
        size = rows, columns = grid_size(self.size)
        footprints = Coverage.of(self.coverage, rows * columns)
        count, each = (rows * columns, "cell") if footprints is None else (footprints.num_sensors, "sensor")
        prices = one_each("cost", self.cost, count, each, PRICES)
        safe = prices.sum() if self.safe_cost is _SUM else self.safe_cost
        checked: dict[str, Any] = {"size": size, "cost": prices, "coverage": footprints}
        checked["safe_cost"] = _price("safe_cost", safe, LARGEST_PRICE * prices.size)
        checked["reward"] = _price("reward", self.reward)
        for name in ("detection", "safe_detection"):
            checked[name] = one_each(name, getattr(self, name), rows * columns, "cell", PROBABILITIES)
        for name, lowest in (("t_max", 0), ("max_steps", 1), ("window", 0), ("clip", 1), ("revealed", 1)):
            value = getattr(self, name)
            checked[name] = None if value is None and name in _NULLABLE else _at_least(lowest, name, value)
        for name, value in checked.items():
            object.__setattr__(self, name, value)  # the dataclass is frozen
        # Keys are counted up to t_max + 1 misses, and a safe action that misses is repeated.
        if self.memory != "cell" and not self.safe:
            raise UserError(f"memory={self.memory}: with a safe action that may miss, expected cell")
        if self.memory != "cell" and self.revealed > 1:
            raise UserError(f"memory={self.memory}: where a detection tells the mode, expected cell")
        if footprints is not None:
            self._check_footprints()

    def _check_footprints(self) -> None:
        """Refuse what sensors that cover several cells do not go together with."""
        if self.window is not None:
            raise UserError(f"window={self.window}: expected None with coverage, whose sensors lie at no cell")
        if self.memory != "cell":
            raise UserError(f"memory={self.memory}: expected cell with coverage")
        if not (self.perfect and self.safe):
            raise UserError("detection, safe_detection: expected 1 with coverage; within a footprint nothing is missed")

    @property
    def rows(self) -> int:
        """Rows of the grid."""
        return self.size[0]

    @property
    def columns(self) -> int:
        """Columns of the grid."""
        return self.size[1]

    @property
    def num_cells(self) -> int:
        """M = rows · columns."""
        return self.rows * self.columns

    @property
    def total_sensors(self) -> int:
        """S, all sensors there are: one in each cell, or those of `coverage`."""
        return self.num_cells if self.coverage is None else self.coverage.num_sensors

    @property
    def num_choices(self) -> int:
        """T_max + 1, the free choices between two forced ones."""
        return self.t_max + 1

    @property
    def num_sensors(self) -> int:
        """K, the sensors that can be chosen from one located cell: S, or (2W+1)² with a window."""
        return self.total_sensors if self.window is None else (2 * self.window + 1) ** 2

    @cached_property
    def perfect(self) -> bool:
        """Whether every sensor that is on reports the target in its cell."""
        return bool((self.detection == 1.0).all())

    @cached_property
    def safe(self) -> bool:
        """Whether the safe action always locates the target."""
        return bool((self.safe_detection == 1.0).all())

    def detects(self, cells: npt.NDArray[Any]) -> Array | float:
        """`[E]` p_d of `cells` `[E]`; simply 1.0 where no sensor misses, so that perfect sensors cost no look-up."""
        return 1.0 if self.perfect else self.detection[cells]

    def covered(self, action: BoolArray) -> BoolArray:
        """`[..., M]`, the cells that the sensors of `action` `[..., S]` see: the action itself, but for footprints."""
        return action if self.coverage is None else self.coverage.cells(action)

    @property
    def safe_misses(self) -> Array | float:
        """`[M]` 1 - p_s; simply 0.0 where the safe action always locates."""
        return 0.0 if self.safe else 1.0 - self.safe_detection

    @cached_property
    def keys(self) -> KeySpace:
        """What a policy may remember at a detection; with `memory` "cell" the keys are the cells, or (cell, mode)."""
        return KeySpace(self.size, self.t_max, self.memory, self.clip, self.revealed)

    def remembering(self, memory: str = "cell", *, clip: int = 2, revealed: int = 1) -> Task:
        """The same task, in which a policy remembers this: by default the cell alone."""
        return Task(**self.given | {"memory": memory, "clip": clip, "revealed": revealed})

    @property
    def order(self) -> int:
        """Detections before the last one that a policy may remember something of."""
        return self.keys.order

    @property
    def keyed(self) -> bool:
        """Whether a policy knows more at a detection than the cell."""
        return self.keys.num_classes > 1

    @property
    def pair_bytes(self) -> int:
        """Bytes that exact evaluation takes where targets have a mode (`HiddenWorld`)."""
        return 0

    @property
    def num_keys(self) -> int:
        """Plans of a policy, one for each key."""
        return self.keys.num_keys

    @property
    def task(self) -> Task:
        """The same task without the motion."""
        return Task(**self.given)

    @property
    def given(self) -> dict[str, Any]:
        """All that a `Task` holds, as arguments of its constructor and of that of `World`."""
        return {name: getattr(self, name) for name in Task.__dataclass_fields__}


@dataclass(frozen=True, eq=False, init=False)
class World(Task):
    """A task together with the target's motion (paper, Section II), which solvers may read and learners may not.

    Args:
        kernel: `[M, M]` table of P, sparse or dense.
        size: see `Task`, as are all further arguments.

    Attributes:
        kernel: `[M, M]` canonical CSR matrix P of float64, without explicit zeros; row i sums to 1 - p_exit(i).

    Raises:
        UserError: `kernel` is no sub-stochastic table for this grid, or without `max_steps` some cell has no way out.
    """

    kernel: sparse.csr_array

    def __init__(
        self,
        kernel: sparse.sparray | sparse.spmatrix | npt.NDArray[np.generic],
        size: Size,
        **of_task: Unpack[TaskOptions],
    ) -> None:
        super().__init__(size, **of_task)  # type: ignore[arg-type]  # which makes arrays of them
        # Checked after it is canonical: duplicates are added up and zeros dropped, so that the checks see what solvers
        # will.
        canonical = canonical_kernel(kernel)
        check_kernel(canonical, self.size, truncates=self.max_steps is not None)
        object.__setattr__(self, "kernel", canonical)

    @classmethod
    def of(cls, task: Task, kernel: sparse.sparray | npt.NDArray[np.generic], **changes: Any) -> World:
        """The world of a task with a `kernel` `[M, M]`; `changes` are arguments that differ from the task's."""
        return cls(kernel, **(task.given | changes))

    @cached_property
    def stay_probability(self) -> Array:
        """`[M]` probability of still being in the grid after one step, 1 - p_exit."""
        # Not kernel.sum(axis=1), which may differ in the last digit from the sums of the same kernel written out.
        return pairwise_row_sums(self.kernel)

    @cached_property
    def safe_gain(self) -> Array:
        """`[M]` expected reward of one safe action when the target is in each cell: r sum_j P_xj p_s(j) - D P_in(x)."""
        gain: Array = (self.reward - self.safe_cost) * self.stay_probability
        return gain if self.safe else gain - self.reward * (self.kernel @ (1.0 - self.safe_detection))


def apart(columns: int, start: npt.NDArray[Any], end: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """How far cells lie apart, in rows or in columns, whichever is more; arrays of any shapes that go together."""
    (row, column), (other_row, other_column) = np.divmod(start, columns), np.divmod(end, columns)
    return np.maximum(np.abs(row - other_row), np.abs(column - other_column))


def grid_size(size: Size) -> tuple[int, int]:
    """(rows, columns) of one number, or of two.

    Raises:
        UserError: these are no whole numbers of at least 1.
    """
    pair = (size, size) if isinstance(size, (int, np.integer)) else tuple(size)
    if len(pair) != 2 or not all(isinstance(side, (int, np.integer)) and side >= 1 for side in pair):
        raise UserError(f"size={size}: expected an integer >= 1, or two of them, rows and columns")
    return int(pair[0]), int(pair[1])


def _price(name: str, value: float, most: float = LARGEST_PRICE) -> float:
    if not 0 <= value <= most:
        raise UserError(f"{name}={value}: expected a number from 0 to {most:g}")
    return float(value)


def _at_least(lowest: int, name: str, value: int) -> int:
    if not isinstance(value, (int, np.integer)) or value < lowest:
        raise UserError(f"{name}={value}: expected an integer >= {lowest}")
    return int(value)
