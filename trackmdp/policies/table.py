"""What a policy does in every state, as a table: the part of a policy that planning and exact evaluation need.

It loads without torch, so that solving a world from the command line does not wait for it; `Policy` adds the acting.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any, Self

import numpy as np
import numpy.typing as npt
from scipy import sparse

from trackmdp.errors import UserError
from trackmdp.world.checks import short_indices
from trackmdp.world.model import Array, BoolArray, Task, apart


class PolicyTable:
    """Which sensors are on n misses after the target was located: one open-loop plan for each key (`world/memory.py`).

    With `task.memory` "cell" the key is the located cell x. What a policy remembers is its own: a policy of one memory
    may be valued in a task of another.

    Args:
        task: grid, costs, limits and memory.
        sets: `[keys * (t_max + 1), S]` sparse; row `key * (t_max + 1) + n` is the set at n misses after the detection
            that left `key`; S = M, a sensor in each cell, or the sensors of `task.coverage`. Bool entries are sensors
            on; entries in (0, 1] are the probabilities of switching them on, independently of each other and of the
            history.
        probability: the same for every sensor in every state, instead of `sets`; in a task with a window, for every
            sensor in the window of the located cell, which is then written out as `sets`.
        k: exactly k sensors are on, each such subset equally likely; `sets` or `probability` then has each sensor's
            share of them, which is all that exact values depend on.

    Attributes:
        deterministic: whether the policy is the same function of the state each time.

    Raises:
        UserError: the shape is not that of the task's states, or an entry is no probability.
    """

    def __init__(
        self,
        task: Task,
        sets: sparse.csr_array | None = None,
        *,
        probability: float | None = None,
        k: int | None = None,
    ) -> None:
        if (sets is None) == (probability is None):
            raise UserError("policy: expected either sets or one probability for all sensors")
        if probability is not None and not 0.0 <= probability <= 1.0:
            raise UserError(f"policy: expected a probability between 0 and 1, got {probability}")
        if k is not None and not 0 <= k <= task.total_sensors:
            raise UserError(f"policy: expected k from 0 to {task.total_sensors} sensors, got {k}")
        self.task, self.probability, self.k = task.task, probability, k
        self.sets = None if sets is None else _checked(task, sets)
        if probability and task.window is not None:
            # Which sensors there are depends on where the target was located: no longer the same everywhere.
            self.sets, self.probability = _window_sets(task, probability), None
        self.deterministic = probability in (0.0, 1.0) if self.sets is None else self.sets.dtype == np.bool_

    @classmethod
    def all_on(cls, task: Task) -> Self:
        """Every sensor on at every step."""
        return cls(task, probability=1.0)

    @classmethod
    def none(cls, task: Task) -> Self:
        """No sensor ever on: the target is located by the safe action alone."""
        return cls(task, probability=0.0)

    @classmethod
    def from_dense(cls, task: Task, table: npt.NDArray[np.generic]) -> Self:
        """A policy from `[keys, t_max + 1, S]`, bool or probabilities."""
        expected = (task.num_keys, task.num_choices, task.total_sensors)
        if table.shape != expected:
            raise UserError(f"policy: expected shape {expected} (keys, t_max + 1, sensors), got {table.shape}")
        return cls(task, sparse.csr_array(np.ascontiguousarray(table).reshape(-1, task.total_sensors)))

    @classmethod
    def from_sensed(cls, task: Task, parts: Sequence[tuple[npt.NDArray[Any], npt.NDArray[Any]]]) -> Self:
        """A policy that does not draw, from what is on at n = 0 ... t_max: the keys and the sensors, `[Q]` each."""
        # Key x after n misses is row x (t_max + 1) + n: with t_max = 1, (x, n) = (3, 1) is row 7.
        # rows of several n interleave, so that the table is sorted once all are there
        rows = np.concatenate([keys * task.num_choices + n for n, (keys, _) in enumerate(parts)])
        sensors = np.concatenate([on for _, on in parts])
        shape = (task.num_keys * task.num_choices, task.total_sensors)
        table = sparse.csr_array((np.ones(len(rows), dtype=bool), (rows, sensors)), shape=shape)
        table.sort_indices()
        return cls(task, short_indices(table))

    # What exact evaluation reads, for arrays of any E.

    def on(self, n: int, rows: npt.NDArray[Any], cells: npt.NDArray[Any]) -> Array:
        """`[E]` probability that a sensor on sees `cells` `[E]`, n misses after the detection of key `rows` `[E]`."""
        if self.sets is None:
            assert self.probability is not None
            if self.task.coverage is not None:
                return self.task.coverage.share(self.probability, self.k)[cells]
            return np.full(len(rows), self.probability)
        # Entry (row r, column j) of the table has the number r * M + j; the numbers of those stored are in order.
        # With M = 4 and t_max = 1: located in 2, after 1 miss, sensor 3 is entry (2 * 2 + 1) * 4 + 3 = 23.
        wanted = (np.asarray(rows, dtype=np.int64) * self.task.num_choices + n) * self.task.num_cells + cells
        place = np.searchsorted(self._entries, wanted)
        found: BoolArray = self._entries[place] == wanted
        if self.deterministic:
            return found.astype(np.float64)
        return np.where(found, np.append(self.seen.data, 0.0)[place], 0.0)

    def chosen(self, n: int, rows: npt.NDArray[Any], sensors: npt.NDArray[Any]) -> Array:
        """`[E]` probability that `sensors` `[E]` are on, n misses after the detection of key `rows` `[E]`."""
        if self.task.coverage is None:
            return self.on(n, rows, sensors)
        if self.sets is None:
            return np.full(len(rows), self.probability)
        # Entry by entry: with footprints only planners ask, for the few pairs of their layers.
        wanted = np.asarray(rows) * self.task.num_choices + n
        return np.asarray(self.sets[wanted, sensors], dtype=np.float64)

    def spent(self, n: int, price: Array) -> Array:
        """`[keys]` expected price of the sensors on, n misses after each key; `price` `[S]` is per sensor."""
        if self.sets is None:
            assert self.probability is not None
            return np.full(self.task.num_keys, self.probability * price.sum())
        # Rows n, n + (t_max + 1), ...: those of (0, n), (1, n), ..., one per key.
        rows = self.sets[n :: self.task.num_choices]
        return rows.astype(np.float64) @ price

    def watched(self, used: Array) -> Array:
        """`[M]` how often each cell is seen by a sensor, where the sets are used `[keys * (t_max + 1)]` often."""
        if self.sets is None:
            every = np.zeros(self.task.num_cells, dtype=np.int64)
            return used.sum() * self.on(0, every, np.arange(self.task.num_cells))
        return used @ self.seen

    @cached_property
    def seen(self) -> sparse.csr_array:
        """`[keys * (t_max + 1), M]`, which cells the sets see, or with what probability: `sets`, but for footprints."""
        return self.sets if self.task.coverage is None else self.task.coverage.seen(self.sets)

    @cached_property
    def _entries(self) -> npt.NDArray[np.int64]:
        """`[nnz + 1]` sorted numbers r * M + j of the entries of `seen`, closed by the largest int64 as a sentinel."""
        row = np.repeat(np.arange(self.seen.shape[0], dtype=np.int64), np.diff(self.seen.indptr))
        return np.append(row * self.task.num_cells + self.seen.indices, np.iinfo(np.int64).max)

    def check_fits(self, task: Task) -> None:
        """Refuse a task of another grid, of other footprints or of another t_max.

        Raises:
            UserError: it is.
        """
        mine, other = self.task.coverage, task.coverage
        if not (mine is other or (mine is not None and mine.same_as(other))):
            raise UserError("policy: made for sensors of other footprints than the world's")
        if (self.task.size, self.task.t_max) != (task.size, task.t_max):
            theirs, ours = (f"{each.rows} x {each.columns} cells, t_max {each.t_max}" for each in (self.task, task))
            raise UserError(f"policy: made for {theirs}; expected {ours}")

    def dense(self) -> BoolArray:
        """`[keys, t_max + 1, S]`, the sets of a deterministic policy, a byte each, so for small worlds alone.

        Raises:
            UserError: the policy draws its sets.
        """
        if not self.deterministic:
            raise UserError("policy: draws its sets at random, so that there is no table of them")
        shape = (self.task.num_keys, self.task.num_choices, self.task.total_sensors)
        if self.sets is None:
            return np.full(shape, self.probability == 1.0)
        return self.sets.toarray().reshape(shape)

    def as_lists(self) -> dict[str, Any]:
        """Plain lists, as `sets.json` has them: rows and columns, t_max, and each key's sensors on at n = 0 ... t_max.

        With `task.memory` "cell" the keys are the located cells; else `memory` says how they are numbered, and
        where a detection tells the mode its kind is "cell", each cell's classes being the modes. Where
        sensors do not each cover the cell of their number, `footprints` says which cells each covers.
        """
        m, choices = self.task.num_cells, self.task.num_choices
        if self.sets is None:
            each = list(range(self.task.total_sensors)) if self.probability == 1.0 else []
            return self._of_task() | {"sets": {str(cell): [each] * choices for cell in range(m)}}
        lists = [part.tolist() for part in np.split(self.sets.indices, self.sets.indptr[1:-1])]
        sets = {str(key): lists[key * choices : (key + 1) * choices] for key in range(self.task.num_keys)}
        return self._of_task() | {"sets": sets}

    def _of_task(self) -> dict[str, Any]:
        """What a reader of the lists has to know; what is not there is the paper's."""
        task = self.task
        told: dict[str, Any] = {"size": list(task.size), "t_max": task.t_max}
        if task.coverage is not None:
            told["footprints"] = task.coverage.as_lists()
        if task.keyed:
            told["memory"] = {"kind": task.memory, "clip": task.clip, "classes": task.keys.num_classes}
            told["memory"] |= {"revealed": task.revealed} if task.revealed > 1 else {}
        return told


def _checked(task: Task, sets: sparse.csr_array) -> sparse.csr_array:
    """The sets in canonical form: sorted, no entries of zero, bool where all entries are 0 or 1.

    Raises:
        UserError: another shape, or entries that are no probabilities.
    """
    expected = (task.num_keys * task.num_choices, task.total_sensors)
    if sets.shape != expected:
        raise UserError(f"policy: expected sets of shape {expected} (keys (t_max + 1), sensors), got {sets.shape}")
    sets = sparse.csr_array(sets, copy=True)
    if sets.dtype != np.bool_:
        if not ((sets.data >= 0) & (sets.data <= 1)).all():
            raise UserError("policy: expected probabilities between 0 and 1")
        # All entries 0 or 1: nothing is drawn, and the policy can be valued and acted out as deterministic.
        sets = sets.astype(np.bool_ if np.isin(sets.data, (0, 1)).all() else np.float64)
    sets.sum_duplicates()  # sorts the columns of each row as well
    sets.eliminate_zeros()
    if task.window is not None:
        start = task.keys.cell(np.repeat(np.arange(sets.shape[0]), np.diff(sets.indptr)) // task.num_choices)
        far = apart(task.columns, start, sets.indices) > task.window
        if far.any():
            x, cell = int(start[far][0]), int(sets.indices[far][0])
            raise UserError(f"policy: sensor {cell} cannot be chosen from cell {x} with grid.window={task.window}")
    return sets


def _window_sets(task: Task, probability: float) -> sparse.csr_array:
    """`[keys (t_max + 1), M]`, every sensor of the window around each located cell, with one probability."""
    assert task.window is not None
    # A cell is near where its row is and its column is: the Kronecker product of both.
    reach = (min(task.window, side - 1) for side in task.size)
    rows, columns = (
        sum(sparse.eye_array(side, k=k) for k in range(-far, far + 1))
        for side, far in zip(task.size, reach, strict=True)
    )
    near = sparse.kron(rows, columns, format="csr") * probability
    near.sort_indices()
    near = short_indices(sparse.csr_array(near, dtype=np.float64 if probability < 1 else np.bool_))
    return near[np.repeat(np.arange(task.num_cells), task.keys.num_classes * task.num_choices)]
