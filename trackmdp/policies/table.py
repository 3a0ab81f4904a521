"""A policy's table: its sets or probabilities in every state, as planning and exact evaluation need them.

It loads without torch, so that solving a world from the command line does not wait for it; `Policy` adds the acting.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any, Self

import numpy as np
import numpy.typing as npt
from scipy import sparse

from trackmdp.arrays.entries import ones_at, short_indices
from trackmdp.arrays.numbers import whole_number
from trackmdp.arrays.types import AnyArray, Array, BoolArray
from trackmdp.errors import UserError
from trackmdp.memory.keys import KeySpace
from trackmdp.notebook.card import Card, Carded, decimal, grid_words
from trackmdp.sensing.coverage import reported
from trackmdp.sensing.task import Task, window_cells

_AT_ONCE = 2**19
"""Entries looked up or checked at once: some 16 MB of intermediate arrays, however large the grid."""
_SMALL = 2**20  # entries of a table that is kept dense for look-ups


class SetTable:
    """Sets of sensors in rows, t_max + 1 for each plan: the input of exact evaluation.

    Args:
        task: sensors and prices.
        sets: `[plans * (t_max + 1), S]` sparse, bool or probabilities; row `plan * (t_max + 1) + n` is the set after n
            misses. Or one row, which stands for all: then they are `alike`.
        plans: number of plans.
        k: exactly k sensors of each row are on; see `PolicyTable`.
    """

    def __init__(
        self, task: Task, sets: sparse.csr_array, plans: int, *, k: int | None = None
    ) -> None:
        self.task, self.sets, self.plans, self.k = task, sets, plans, k
        self.alike = sets.shape[0] == 1
        self.deterministic = bool(sets.dtype == np.bool_)

    def sensed_by(self, task: Task) -> SetTable:
        """The same sets with the sensors of `task`, which may report with other probabilities."""
        if np.array_equal(self.task.detection, task.detection):
            return self
        return SetTable(task, self.sets, self.plans, k=self.k)

    def chosen(self, n: int, plans: AnyArray, sensors: AnyArray) -> Array:
        """`[E]` probability that `sensors` `[E]` are on, after n misses in each plan `[E]`."""
        return self._looked_up(self._chosen, n, plans, sensors)

    def reports(self, n: int, plans: AnyArray, cells: AnyArray) -> Array:
        """`[E]` probability that a target in `cells` `[E]` is reported after n misses in each plan."""
        task = self.task
        if task.coverage is None:
            return self.chosen(n, plans, cells) * task.detects(cells)
        return self._looked_up(self._reported, n, plans, cells)

    @cached_property
    def _chosen(self) -> Any:
        return _quick(self.sets)

    @cached_property
    def _reported(self) -> Any:
        return _quick(self.reporting)

    def _looked_up(self, table: Any, n: int, plans: AnyArray, columns: AnyArray) -> Array:
        """`[E]`, the entries of row plan (t_max + 1) + n of a table in `columns`."""
        found = np.empty(len(columns))
        for begin in range(0, len(columns), _AT_ONCE):
            part = slice(begin, begin + _AT_ONCE)
            row = np.asarray(plans[part], np.int64) * self.task.num_choices + n
            row = 0 * row if self.alike else row
            found[part] = table[row, columns[part]]
        return found

    def spent(self, n: int, price: Array) -> Array:
        """`[plans]` expected price of the sensors on after n misses; `price` `[S]` is per sensor."""
        # Rows n, n + (t_max + 1), ...: those of (0, n), (1, n), ..., one per plan.
        rows = self.sets if self.alike else self.sets[n :: self.task.num_choices]
        return np.broadcast_to(rows.astype(np.float64) @ price, self.plans)

    def watched(self, used: Array) -> Array:
        """`[M]` how often each cell is covered, where the sets are used `[plans * (t_max + 1)]` often."""
        return (used.sum(keepdims=True) if self.alike else used) @ self.seen

    @cached_property
    def seen(self) -> sparse.csr_array:
        """The rows of `sets`, over cells: probability that each is sensed; `sets` itself without footprints."""
        if self.task.coverage is None:
            return self.sets
        covers = sparse.csr_array(self.task.sees_by_cell > 0, dtype=np.float64)
        found = reported(self.sets, covers.T.tocsr(), self.k)
        return found.astype(np.bool_) if self.deterministic else found

    @cached_property
    def reporting(self) -> sparse.csr_array:
        """The rows of `sets`, over cells: probability of a report of a target; bool where all are certain."""
        task = self.task
        if task.coverage is not None and not task.perfect:
            return reported(self.sets, task.sees_by_cell.T.tocsr(), self.k)
        if task.perfect:
            return self.seen
        return sparse.csr_array(self.sets.multiply(task.detection))


class PolicyTable(Carded, SetTable):
    """Which sensors are on n misses after the target was located: one open-loop plan for each key (`memory/keys.py`).

    With `task.memory` "cell" the key is the located cell x. A policy has its own memory: a policy of one memory
    may be valued in a task of another.

    Args:
        task: grid, costs, limits and memory.
        sets: `[keys * (t_max + 1), S]` sparse; row `key * (t_max + 1) + n` is the set at n misses after the detection
            that left `key`; S = M, a sensor in each cell, or the sensors of `task.coverage`. Bool entries are sensors
            on; entries in (0, 1] are the probabilities of switching them on, independently of each other and of the
            history. One row stands for all keys and numbers of misses.
        probability: of every sensor that can be chosen, in every state, instead of `sets`.
        k: exactly k sensors are on, each such subset equally likely; `sets` or `probability` then has each sensor's
            share of them, which is all that exact values depend on.

    Attributes:
        deterministic: whether the policy is the same function of the state each time.

    Raises:
        UserError: the shape does not fit the task's states, or an entry is no probability.
    """

    def __init__(
        self,
        task: Task,
        sets: sparse.csr_array | None = None,
        *,
        probability: float | None = None,
        k: int | None = None,
    ) -> None:
        if not isinstance(task, Task):
            raise UserError(f"policy: a {type(task).__name__}, expected a world or recorded tracks")
        if (sets is None) == (probability is None):
            raise UserError("policy: expected either sets or one probability for all sensors")
        if probability is not None and not 0.0 <= probability <= 1.0:
            raise UserError(f"policy: expected a probability between 0 and 1, got {probability}")
        if k is not None:
            k = whole_number("policy: k", k, 0, task.total_sensors)
        sets = _choosable_sets(task, probability) if sets is None else sets
        super().__init__(task.task, _checked(task, sets), task.num_keys, k=k)

    def card(self) -> Card:
        """Size, memory and the mean number of sensors on."""
        task = self.task
        drawn = f"exactly {self.k} sensors" if self.k is not None else "each sensor on its own"
        facts = {
            "T_max": f"{task.t_max}",
            "memory": f"{task.memory}, {task.num_keys:,} keys",
            "choice": "deterministic" if self.deterministic else f"drawn, {drawn}",
        }
        if task.window is not None:
            facts["window"] = f"{task.window} cells around the last located cell"
        for n in range(task.num_choices):
            mean = float(self.spent(n, np.ones(task.total_sensors)).mean())
            facts[f"sensors on at n = {n}"] = f"{decimal(mean, 2)} of {task.total_sensors:,}"
        return Card(f"{type(self).__name__}: {grid_words(task.size)}", facts)

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
        """A policy from `[keys, t_max + 1, S]`, bool or probabilities.

        Raises:
            UserError: it has another shape, or holds other things than real numbers.
        """
        if table.dtype.kind not in "biuf":
            raise UserError(f"policy: a table of {table.dtype}, expected bool or probabilities")
        expected = (task.num_keys, task.num_choices, task.total_sensors)
        if table.shape != expected:
            raise UserError(
                f"policy: expected shape {expected} (keys, t_max + 1, sensors), got {table.shape}"
            )
        return cls(
            task, sparse.csr_array(np.ascontiguousarray(table).reshape(-1, task.total_sensors))
        )

    @classmethod
    def from_sensed(cls, task: Task, parts: Sequence[tuple[AnyArray, AnyArray]]) -> Self:
        """A policy that does not draw, from the keys and their sensors on, `[Q]` each, at n = 0 ... t_max."""
        # Key x after n misses is row x (t_max + 1) + n: with t_max = 1, (x, n) = (3, 1) is row 7.
        # rows of several n interleave, so that the table is sorted once all are there
        rows = np.concatenate([keys * task.num_choices + n for n, (keys, _) in enumerate(parts)])
        sensors = np.concatenate([on for _, on in parts])
        table = ones_at(rows, sensors, (task.num_keys * task.num_choices, task.total_sensors))
        table.sort_indices()
        return cls(task, short_indices(table))

    def check_fits(self, task: Task) -> None:
        """Refuse a task of another grid, of other footprints or t_max, or in which sensors that may be on may not be.

        Raises:
            UserError: it is.
        """
        mine, other = self.task.coverage, task.coverage
        if not (mine is other or (mine is not None and mine.same_as(other))):
            raise UserError("policy: made for sensors of other footprints than the world's")
        if (self.task.size, self.task.t_max) != (task.size, task.t_max):
            theirs, ours = (
                f"{each.rows} x {each.columns} cells, t_max {each.t_max}"
                for each in (self.task, task)
            )
            raise UserError(f"policy: made for {theirs}; expected {ours}")
        gone = self.task.available & ~task.available
        on = self.sets.indices[gone[self.sets.indices]]
        if len(on):
            raise UserError(f"policy: sensor {on[0]} may be on; the world has none there")
        if task.budget is not None and (most := self.most_on) > task.budget:
            raise UserError(f"policy: up to {most} sensors on in a step; expected {task.budget}")
        if (far := task.window) is not None and (
            self.task.window is None or self.task.window > far
        ):
            self._check_near(task)

    def _check_near(self, task: Task) -> None:
        """Refuse a task in whose window a sensor that may be on cannot be chosen."""
        if not self.alike:
            _check_choosable(task, self.task.keys, self.sets)
        elif self.sets.nnz:
            for cell in range(task.num_cells):  # the one row written out for all might not fit
                _check_from(task, np.full(self.sets.nnz, cell), self.sets.indices)

    @cached_property
    def most_on(self) -> int:
        """Sensors that may be on in one step."""
        return int(np.diff(self.sets.indptr).max(initial=0)) if self.k is None else self.k

    def dense(self) -> BoolArray:
        """`[keys, t_max + 1, S]`, the sets of a deterministic policy, a byte each, so for small worlds alone.

        Raises:
            UserError: the policy draws its sets.
        """
        if not self.deterministic:
            raise UserError("policy: draws its sets at random, so that there is no table of them")
        shape = (self.task.num_keys, self.task.num_choices, self.task.total_sensors)
        return self.written.toarray().reshape(shape)

    @cached_property
    def written(self) -> sparse.csr_array:
        """`[keys * (t_max + 1), S]` sets, also where one row stands for all."""
        rows = self.task.num_keys * self.task.num_choices
        return self.sets[np.zeros(rows, np.int64)] if self.alike else self.sets

    def as_lists(self) -> dict[str, Any]:
        """Plain lists, as `sets.json` has them: rows and columns, t_max, and each key's sensors on at n = 0 ... t_max.

        With `task.memory` "cell" the keys are the located cells; else `memory` holds their formulas, and where a
        detection reveals the mode its kind is "cell", each cell's classes being the modes. Where sensors do not each
        cover the cell of their number, `footprints` lists the cells of each.
        """
        task = self.task
        # Facts that are missing have the paper's values.
        facts: dict[str, Any] = {"size": list(task.size), "t_max": task.t_max}
        if task.coverage is not None:
            facts["footprints"] = task.coverage.as_lists()
        if task.place is not None:
            facts["place"] = task.place.facts()
        if task.keyed:
            own = {"kind": task.memory, "clip": task.clip, "classes": task.keys.num_classes}
            own |= {"revealed": task.revealed} if task.revealed > 1 else {}
            facts["memory"] = own | task.keys.recipe()
        steps = range(task.num_choices)
        sets = {str(key): [self.sensors(key, n) for n in steps] for key in range(task.num_keys)}
        return facts | {"sets": sets}

    def sensors(self, key: int, misses: int) -> list[int]:
        """The sensors with a probability above 0, n misses after the detection that left `key`."""
        return self.sets.indices[self._entries_of(key, misses)].tolist()

    def chances(self, key: int, misses: int) -> Array:
        """The probabilities of `sensors`."""
        return self.sets.data[self._entries_of(key, misses)].astype(np.float64)

    def _entries_of(self, key: int, misses: int) -> slice:
        """The entries of a row of `sets`."""
        row = 0 if self.alike else key * self.task.num_choices + misses
        return slice(*self.sets.indptr[row : row + 2])


def _quick(table: sparse.csr_array) -> Any:
    """The table dense where it is small: SciPy takes fifty microseconds before it looks up the first entry."""
    return table.toarray() if table.shape[0] * table.shape[1] <= _SMALL else table


def _checked(task: Task, sets: sparse.csr_array) -> sparse.csr_array:
    """The sets in canonical form: sorted, no entries of zero, bool where all entries are 0 or 1.

    Raises:
        UserError: another shape, or entries that are no probabilities.
    """
    expected = (task.num_keys * task.num_choices, task.total_sensors)
    if sets.shape not in (expected, (1, task.total_sensors)):
        raise UserError(
            f"policy: expected sets of shape {expected} (keys (t_max + 1), sensors), got {sets.shape}"
        )
    sets = sparse.csr_array(sets, copy=True)
    if sets.dtype != np.bool_:
        if not ((sets.data >= 0) & (sets.data <= 1)).all():
            raise UserError("policy: expected probabilities between 0 and 1")
        # All entries 0 or 1: nothing is drawn, and the policy can be valued and acted out as deterministic.
        sets = sets.astype(np.bool_ if np.isin(sets.data, (0, 1)).all() else np.float64)
    sets.sum_duplicates()  # sorts the columns of each row as well
    sets.eliminate_zeros()
    if sets.shape != expected and task.window is not None and sets.nnz:
        sets = sets[np.zeros(expected[0], np.int64)]  # each cell has a window of its own
    _check_choosable(task, task.keys, sets)
    return sets


def _check_choosable(task: Task, keys: KeySpace, sets: sparse.csr_array) -> None:
    """Refuse sets, a row for each of `keys` and number of misses, with sensors that cannot be chosen."""
    if task.window is None and task.available.all():
        return
    for begin in range(0, sets.nnz, _AT_ONCE):
        places = np.arange(begin, min(begin + _AT_ONCE, sets.nnz))
        # An entry's row is the last one that begins at or before it: indptr = (0, 2, 2, 5), place 2 is in row 2.
        row = np.searchsorted(sets.indptr, places, side="right") - 1
        _check_from(task, keys.cell(row // task.num_choices), sets.indices[places])


def _check_from(task: Task, start: AnyArray, sensors: AnyArray) -> None:
    """Refuse `sensors` `[E]` of which one cannot be chosen from its located cell in `start` `[E]`."""
    possible = task.choosable(start, sensors)
    if possible is not None and not possible.all():
        x, sensor = int(start[~possible][0]), int(sensors[~possible][0])
        missing = not task.available[sensor]
        why = "for there is none" if missing else f"with grid.window={task.window}"
        raise UserError(f"policy: sensor {sensor} cannot be chosen from cell {x}, {why}")


def _choosable_sets(task: Task, probability: float | None) -> sparse.csr_array:
    """Every sensor that can be chosen from each located cell, with one probability; without a window, one row."""
    if task.window is None or not probability:
        return sparse.csr_array([task.available * (probability or 0.0)])
    near = window_cells(task.size, task.window) if task.coverage is None else task.sensors_near
    near = short_indices(sparse.csr_array(near.multiply(task.available) * probability))
    return near[np.repeat(np.arange(task.num_cells), task.keys.num_classes * task.num_choices)]
