"""The positions that the target can reach from each located cell, move by move: what plans of sets are indexed by.

Layer t holds one entry per pair (located cell x, cell j reachable from x in t moves), so that work on all located
cells at once is a few sparse products whose cost and memory follow the support of the kernel, not M².

On a line of four cells whose target moves one cell to the right, or stays in cell 3:

    layer 0: (0,0) (1,1) (2,2) (3,3)        layer 1: (0,1) (1,2) (2,3) (3,3)        layer 2: (0,2) (1,3) (2,3) (3,3)

The sets of a plan are one bool per entry of the layers from the first on: `on[e]` says whether, after as many misses,
the sensor at `cells[e]` is switched on by a plan made when the target was located in `rows[e]`. Where sensors have
footprints, they are one bool per pair of located cell and sensor (`Layer.covering`), and `Layer.seen` says which
entries those see.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from trackmdp.policies.table import PolicyTable
from trackmdp.solvers.cover import Covering
from trackmdp.solvers.renewal import IndexArray, row_index
from trackmdp.world.model import Array, BoolArray, Task, World, apart


@dataclass(frozen=True)
class Layer:
    """The entries after t moves, in order of (row, cell).

    Attributes:
        rows, cells: `[E]`, located cell and possible position of each entry.
        moves: `[E_before, E]`, probability of moving from an entry of the layer before to one of this layer; in
            layer 0, where nothing has moved yet, the identity.
        allowed: `[E]`, whether the sensor at `cells` can be chosen from `rows`; None where all can.
        covering: the sensors that may see the target; None where each covers its own cell, and entries are sensors.
    """

    rows: IndexArray
    cells: IndexArray
    moves: sparse.csr_array
    allowed: BoolArray | None = None
    covering: Covering | None = None

    @property
    def on_rows(self) -> IndexArray:
        """Located cell of each bool of a set."""
        return self.rows if self.covering is None else self.covering.rows

    @property
    def sensors(self) -> IndexArray:
        """The sensor that each bool of a set stands for."""
        return self.cells if self.covering is None else self.covering.sensors

    def seen(self, on: BoolArray) -> BoolArray:
        """`[E]`, the entries that the set `on` sees."""
        return on if self.covering is None else self.covering.seen(on)

    def best(self, on: BoolArray, gain: Array, cost: Array, inside: Array, *, exact: bool) -> BoolArray:
        """The set that gains most where seeing each entry gains `gain` `[E]`, the one before being `on`.

        A sensor costs `cost` `[S]` times the mass `inside` `[M]`. With footprints the best set is looked for by greedy
        and add-drop, no worse than `on`, or with `exact` found by linear and integer programs.
        """
        price = cost[self.sensors] * inside[self.on_rows]
        if self.covering is None:
            # strict: an entry without mass is never sensed, not even by a sensor that costs nothing
            return gain > price
        if exact:
            return self.covering.best(gain, price, exact=True).on > 0
        return self.covering.improve(on, gain, price)


def reachable_layers(world: World, length: int) -> list[Layer]:
    """Layers 0 ... `length`, all located cells together."""
    return reachable(world.kernel, np.arange(world.num_cells), length, world)


def reachable(
    kernel: sparse.csr_array,
    start: IndexArray,
    length: int,
    task: Task | None = None,
    *,
    rows: IndexArray | None = None,
) -> list[Layer]:
    """Layers 0 ... `length` from any cells `start` `[K]`; the rows of the entries are 0 ... K - 1.

    Args:
        kernel: `[M, M]`.
        start: `[K]`.
        length: moves.
        task: whose sensors there are, row k being located in cell k; None for one in each cell, all within reach.
        rows: `[K]` in order, where several starts belong to one row; None for a row each.
    """
    m = kernel.shape[0]
    # Layer 0: entry k is (row k, cell start[k]), before any move.
    rows = np.arange(len(start), dtype=np.int64) if rows is None else rows
    cells = start.astype(np.int64)
    layers = [Layer(rows, cells, sparse.eye_array(len(start), format="csr"))]
    for _ in range(length):
        # [E, M], row e the moves out of the cell of entry e: one kernel row per entry, however many entries share a
        # cell.
        step = kernel[cells]
        # The pair (row 2, cell 5) of a grid of 16 cells has the key 2 * 16 + 5 = 37; sorted keys are the new entries.
        keys, target = np.unique(rows[row_index(step)] * m + step.indices, return_inverse=True)
        # The moves keep their order and row pointer; only the columns are renamed, from cells to entries of the new
        # layer.
        moves = sparse.csr_array((step.data, target, step.indptr), shape=(len(rows), len(keys)))
        rows, cells = np.divmod(keys, m)
        limits = (None, None) if task is None else (within_window(task, rows, cells), Covering.of(task, rows, cells))
        layers.append(Layer(rows, cells, moves, *limits))
    return layers


def within_window(task: Task, rows: IndexArray, cells: IndexArray) -> BoolArray | None:
    """`[E]` whether sensor `cells` can be chosen after locating the target in `rows`; None where all can.

    On a grid of 10 columns with W = 2, sensor 25 (row 2, column 5) can be chosen from cell 3 (row 0, column 3), and
    sensor 26 cannot.
    """
    if task.window is None:
        return None
    return apart(task.columns, rows, cells) <= task.window


def policy_table(task: Task, layers: Sequence[Layer], sets: Sequence[BoolArray]) -> PolicyTable:
    """The policy whose `sets` are given on layers 1 ... t_max + 1."""
    # Layer n + 1 is where the target may be when it is looked for after n misses: zip starts at layers[1].
    sensed = [(layer.on_rows[on], layer.sensors[on]) for layer, on in zip(layers[1:], sets, strict=True)]
    return PolicyTable.from_sensed(task, sensed)


def layer_sets(layers: Sequence[Layer], policy: PolicyTable) -> list[BoolArray]:
    """The sets of layers 1 ... t_max + 1; what a policy senses where the target cannot be is left out."""
    return [policy.chosen(n, layer.on_rows, layer.sensors) > 0 for n, layer in enumerate(layers[1:])]
