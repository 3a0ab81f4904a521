"""The task: all that the tracker knows of its sensors, prices, limits and memory."""

from __future__ import annotations

import math
from dataclasses import KW_ONLY, dataclass
from functools import cached_property
from typing import Any, Required, Self, TypedDict

import numpy as np
import numpy.typing as npt
from scipy import sparse

from trackmdp.arrays.numbers import PRICES, PROBABILITIES, REAL, one_each, whole_number
from trackmdp.arrays.types import AnyArray, Array, BoolArray
from trackmdp.config.sensors import LARGEST_PRICE
from trackmdp.config.world import LARGEST_CLIP, MEMORIES
from trackmdp.errors import UserError
from trackmdp.grid.displacements import apart
from trackmdp.grid.place import Place
from trackmdp.grid.size import TASK_BYTES, check_fits, grid_size
from trackmdp.memory.keys import KeySpace
from trackmdp.notebook.card import Card, Carded, Facts, grid_words, span
from trackmdp.sensing.coverage import Coverage


class TaskOptions(TypedDict, total=False):
    """Arguments that the constructors of `World` and `Recorded` hand on to `Task`'s."""

    cost: Required[npt.ArrayLike]
    t_max: int
    safe_cost: float | None
    reward: float
    max_steps: int | None
    window: int | None
    detection: npt.ArrayLike
    safe_detection: npt.ArrayLike
    coverage: Any
    budget: int | None
    markov: bool
    memory: str
    clip: int
    revealed: int
    place: Place | None


NEVER = 1e30
"""Price of a sensor that does not exist, for planners; finite, so that times no mass it is 0."""

_NULLABLE = ("max_steps", "window", "budget")
_RANGES = {
    # A history of t_max + 1 actions, or of (2W+1)² sensors, of more would not fit, or be worked on for hours.
    "t_max": (0, 10_000),
    "max_steps": (1, math.inf),
    "window": (0, 1024),
    "budget": (0, math.inf),
    "clip": (1, LARGEST_CLIP),
    "revealed": (1, math.inf),
}
"""Whole numbers of a task: the least and the largest."""
_GIVEN: Any = 1.0
_SUM: Any = None
"""Defaults of a task that its constructor makes arrays and a price of."""


@dataclass(frozen=True, eq=False, repr=False)
class Task(Carded):
    """The tracker's knowledge: the grid, the rewards, the costs and the limits, but not the motion.

    A learner is given a `Task`, never a `World`, so that it cannot read the kernel. Cells are numbered row by row: the
    cell in row i and column j is i · columns + j.

    Attributes:
        size: (rows, columns) of the grid; the constructor takes one number for a square grid.
        cost: `[S]`, c: the price of each sensor switched on for one step, nan where there is no sensor; the constructor
            takes one number for all.
        t_max: T_max; the controller chooses freely at n = 0 ... t_max.
        safe_cost: D, the price of the safe action, forced after t_max + 1 misses in a row; default: the sum of all
            prices.
        reward: r, earned when the target is sensed.
        max_steps: episodes are truncated after this many steps; None for never.
        window: W; only the sensors up to W rows and columns from the last located cell can be chosen, those with a
            footprint where a cell of it is. None: all can.
        detection: `[M]`, p_d per cell, in (0, 1]: how likely a sensor that is on reports the target in its cell; the
            constructor takes one number for all cells.
        safe_detection: `[M]`, p_s per cell, in (0, 1]: the same of the safe action; below 1 it is repeated, at D each,
            until it locates the target.
        coverage: the cells that each of the S sensors covers, where that is not its own cell alone; the constructor
            takes a table or sparse matrix `[S, M]` of 0 and 1, or of probabilities that a sensor reports a target
            there, which are multiplied by p_d. None: S = M, sensor s covers cell s.
        budget: B; at most so many sensors may be on in a step, the safe action apart. None: any number.
        markov: whether the next move depends on the content of a detection alone, the cell or, where it reveals it,
            cell and mode, so that a learner may put paths together from moves seen on different ones.
        memory: the policy's key at a detection, one of `trackmdp.config.world.MEMORIES`; see `KeySpace`.
        clip: rows and columns up to which remembered displacements are distinguished.
        revealed: modes of the target that a detection distinguishes; 1 where it reveals the cell alone.
        place: where the grid lies, for `cell_of` and `place_of`; None: not known.

    Raises:
        UserError: a number is out of its range, or `cost` does not have one price per sensor.
    """

    size: tuple[int, int]
    _: KW_ONLY
    cost: Array
    t_max: int = 1
    safe_cost: float = _SUM
    reward: float = 1.0
    max_steps: int | None = None
    window: int | None = None
    detection: Array = _GIVEN
    safe_detection: Array = _GIVEN
    coverage: Coverage | None = None
    budget: int | None = None
    markov: bool = True
    memory: str = "cell"
    clip: int = 2
    revealed: int = 1
    place: Place | None = None

    def __post_init__(self) -> None:
        if self.memory not in MEMORIES:
            raise UserError(f"memory={self.memory}: expected one of {', '.join(MEMORIES)}")
        if not isinstance(self.place, Place | None):
            raise UserError(f"place: a {type(self.place).__name__}, expected a Place or None")
        if not isinstance(self.markov, bool):
            raise UserError(f"markov: a {type(self.markov).__name__}, expected True or False")
        size = rows, columns = grid_size(self.size)
        check_fits("size", self.size, TASK_BYTES)
        footprints = Coverage.of(self.coverage, rows * columns)
        count, each = (size, "cell") if footprints is None else (footprints.num_sensors, "sensor")
        prices = one_each("cost", self.cost, count, each, PRICES)
        if np.isnan(prices).all():
            raise UserError("cost: nan for every sensor, expected one or more prices")
        safe = np.nansum(prices) if self.safe_cost is _SUM else self.safe_cost
        checked: dict[str, Any] = {"size": size, "cost": prices, "coverage": footprints}
        checked["safe_cost"] = _price("safe_cost", safe, LARGEST_PRICE * prices.size)
        checked["reward"] = _price("reward", self.reward)
        for name in ("detection", "safe_detection"):
            checked[name] = one_each(name, getattr(self, name), size, "cell", PROBABILITIES)
        for name, (lowest, most) in _RANGES.items():
            value = getattr(self, name)
            if value is not None or name not in _NULLABLE:
                value = whole_number(name, value, lowest, most)
            checked[name] = value
        for name, value in checked.items():
            object.__setattr__(self, name, value)  # the dataclass is frozen

    def cell_of(self, lat_or_x: float, lon_or_y: float) -> int:
        """The cell of a position: (lat, lon) where the grid lies on a map, else (x, y).

        Raises:
            UserError: it is outside of the grid, or the place of the grid is not known.
        """
        return self._placed("cell_of").cell_of((lat_or_x, lon_or_y), self.size)

    def place_of(self, cell: int) -> tuple[float, float]:
        """The position of the middle of a cell, (lat, lon) where the grid lies on a map, else (x, y).

        Raises:
            UserError: there is no such cell, or the place of the grid is not known.
        """
        place = self._placed("place_of")
        own = whole_number("place_of: cell", cell, 0, self.num_cells - 1)
        return place.place_of(own, self.size)

    def _placed(self, call: str) -> Place:
        if self.place is None:
            raise UserError(
                f"{call}: the place of the grid is not known, expected tracks loaded from positions, or a `place`"
            )
        return self.place

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
        """K, numbers of sensors in an action: S, or (2W+1)² within a window."""
        return self.total_sensors if self.numbered is None else (2 * self.numbered + 1) ** 2

    @property
    def numbered(self) -> int | None:
        """W, where sensors are numbered within the window around the located cell; None: over the whole grid."""
        return self.window if self.coverage is None else None

    @cached_property
    def perfect(self) -> bool:
        """Whether every sensor that is on reports the target in the cells that it covers."""
        certain = self.coverage is None or self.coverage.perfect
        return certain and bool((self.detection == 1.0).all())

    @cached_property
    def safe(self) -> bool:
        """Whether the safe action always locates the target."""
        return bool((self.safe_detection == 1.0).all())

    def detects(self, cells: AnyArray) -> Array | float:
        """`[E]` p_d of `cells` `[E]`; simply 1.0 where no sensor misses, so that perfect sensors cost no look-up."""
        return 1.0 if self.perfect else self.detection[cells]

    def covered(self, action: BoolArray) -> BoolArray:
        """`[..., M]`, the cells that the sensors of `action` `[..., S]` see: the action itself, but for footprints."""
        return action if self.coverage is None else self.coverage.cells(action)

    @property
    def footprints(self) -> str | None:
        """A digest of the cells of each sensor; None where each covers the cell of its number."""
        return None if self.coverage is None else self.coverage.mark

    @cached_property
    def available(self) -> BoolArray:
        """`[S]`, whether there is a sensor."""
        return ~np.isnan(self.cost)

    @property
    def limited(self) -> bool:
        """Whether the budget is below the number of sensors, and so forbids some sets."""
        return self.budget is not None and self.budget < self.available.sum()

    @cached_property
    def paid(self) -> Array:
        """`[S]` prices of the sensors; 0 where there is none."""
        return np.where(self.available, self.cost, 0.0)

    @cached_property
    def prices(self) -> Array:
        """`[S]` prices for a planner: where there is no sensor so high that none is ever worth it."""
        return np.where(self.available, self.cost, NEVER)

    def choosable(self, start: AnyArray | None, sensors: AnyArray) -> BoolArray | None:
        """`[E]`, whether `sensors` `[E]` exist and can be chosen, the target last located in `start` `[E]`.

        Without `start` the window is left out of account. None: all can.
        """
        possible = None if self.available.all() else self.available[sensors]
        if self.window is None or start is None:
            return possible
        if self.coverage is None:
            near = apart(self.columns, start, sensors) <= self.window
        else:
            # SciPy gives a sparse array, not one of bools, where no pair is asked for.
            near = self.sensors_near[start, sensors] if len(start) else np.zeros(0, np.bool_)
        return near if possible is None else near & possible

    @cached_property
    def sensors_near(self) -> sparse.csr_array:
        """`[M, S]` bool, the sensors with a cell of their footprint in the window around each cell."""
        assert self.coverage is not None
        assert self.window is not None
        around = window_cells(self.size, self.window)
        return (around.astype(np.int32) @ (self.coverage.by_cell > 0)) > 0

    @cached_property
    def sees_by_cell(self) -> sparse.csr_array:
        """`[M, S]` CSR, probability that a sensor that is on reports a target in a cell."""
        if self.coverage is None:
            return sparse.diags_array(self.detection, format="csr")
        return self.coverage.matrix.multiply(self.detection).T.tocsr()

    @cached_property
    def keys(self) -> KeySpace:
        """The keys that a policy may have at a detection; with `memory` "cell" the cells, or (cell, mode)."""
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
    def num_keys(self) -> int:
        """Plans of a policy, one for each key."""
        return self.keys.num_keys

    def card(self) -> Card:
        """Size, prices and limits."""
        return Card(f"{type(self).__name__}: {grid_words(self.size)}", self.facts())

    def facts(self) -> Facts:
        """The figures of the card."""
        misses = "1 miss" if self.t_max == 0 else f"{self.num_choices} misses"
        found = {
            "T_max": f"{self.t_max}",
            "price": f"{span(np.nanmin(self.cost), np.nanmax(self.cost))} per sensor and step",
            "safe action": f"D = {self.safe_cost:g}, forced after {misses}",
            "reward": f"{self.reward:g} per detection",
            "sensors": self._sensor_words(),
        }
        if self.keyed:
            found["memory"] = f"{self.memory}, {self.num_keys:,} keys"
        if self.max_steps is not None:
            found["max_steps"] = f"{self.max_steps:,}"
        return found

    def _sensor_words(self) -> str:
        """Number, reach and reliability of the sensors."""
        words = [f"{self.available.sum():,}, one per cell"]
        if self.coverage is not None:
            covered = np.diff(self.coverage.matrix.indptr)
            words = [
                f"{self.available.sum():,}, each over {span(covered.min(), covered.max())} cells"
            ]
        if self.window is not None:
            words.append(f"up to {self.window} cells from the last located cell")
        if self.budget is not None:
            words.append(f"at most {self.budget} on in a step")
        for name, chances in (("p_d", self.detection), ("p_s", self.safe_detection)):
            if (chances < 1.0).any():
                words.append(f"{name} {span(chances.min(), chances.max())}")
        return "; ".join(words)

    @property
    def task(self) -> Task:
        """The same task without the motion."""
        return Task(**self.given)

    @property
    def targets(self) -> tuple[int, ...]:
        """Kind of each target, where there are several (`Group`)."""
        return ()

    @property
    def single(self) -> Self:
        """The problem itself; of a `Group` that of its first target."""
        return self

    @property
    def given(self) -> dict[str, Any]:
        """All that a `Task` holds, as arguments of its constructor and of `World`'s."""
        return {name: getattr(self, name) for name in Task.__dataclass_fields__}


def window_cells(size: tuple[int, int], window: int) -> sparse.csr_array:
    """`[M, M]` bool, the cells up to `window` rows and columns away from each cell."""
    # A cell is near where its row is and its column is: the Kronecker product of both.
    rows, columns = (
        sum(sparse.eye_array(side, k=k) for k in range(-far, far + 1))
        for side, far in zip(size, (min(window, side - 1) for side in size), strict=True)
    )
    near = sparse.csr_array(sparse.kron(rows, columns, format="csr"), dtype=np.bool_)
    near.sort_indices()
    return near


def _price(name: str, value: float, most: float = LARGEST_PRICE) -> float:
    if not isinstance(value, REAL) or not 0 <= value <= most:
        raise UserError(f"{name}={value}: expected a number from 0 to {most:g}")
    return float(value)
