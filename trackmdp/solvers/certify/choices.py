"""Open work of branch and bound: info states with cells to decide on, and partial choices of their next set."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from trackmdp.arrays.entries import among, ends_of, ranks, row_index
from trackmdp.arrays.types import Array, BoolArray, IndexArray
from trackmdp.solvers.certify.joint import Next


@dataclass(frozen=True)
class Frontier:
    """B info states that need a next set, with the K cells (padded) where leaving might pay.

    Attributes:
        start: `[B]`, the problem (located cell) they belong to.
        sets_left: sets still to be chosen, the next one included.
        relaxed: `[B]`, earned so far plus the bound on the rest with every cell at its better choice.
        cells, mass, regret: `[B, K]`; `mass` is located by sensing, `regret` is the cost of sensing against the bound
            on leaving.
        before: `[B, M]`, undetected mass before the target moves.
        missed: `[B, M]`, mass that all sensors together would miss; None where no sensor misses.
        count: `[B]`, cells that are not padding.
        after: where the target goes on to from `cells`; None where that is not looked at.
        origin: the choices these states came from; none at the start.
    """

    start: IndexArray
    sets_left: int
    relaxed: Array
    cells: IndexArray
    mass: Array
    regret: Array
    count: IndexArray
    before: sparse.csr_array
    origin: Origin | None
    missed: sparse.csr_array | None = None
    after: Next | None = None

    @property
    def present(self) -> BoolArray:
        """`[B, K]`, the cells that are not padding."""
        return np.arange(self.cells.shape[1]) < self.count[:, None]

    @classmethod
    def of(
        cls,
        start: IndexArray,
        sets_left: int,
        relaxed: Array,
        before: sparse.csr_array,
        moved: sparse.csr_array,
        regret: Array,
        kept: IndexArray,
        origin: Origin | None,
    ) -> Frontier:
        """The states `kept`, with the entries of `moved` of positive `regret`, the likeliest first."""
        # The entries of `moved` are a ragged table: row s has count[s] of them. They are set into rectangles [B, K];
        # the column of an entry is its number within its row: rows (0, 0, 2) have columns (0, 1, 0).
        # number[s] is the row of state s in the new batch, -1 for one that is not kept.
        number = np.full(len(start), -1)
        number[kept] = np.arange(len(kept))
        rows = number[row_index(moved)]
        entry = np.flatnonzero((regret > 0) & (rows >= 0))
        # a cell without positive regret is sensed in every choice; there is nothing to decide
        entry = entry[np.lexsort((-moved.data[entry], rows[entry]))]
        count = np.bincount(rows[entry], minlength=len(kept))
        shape = (len(kept), int(count.max(initial=0)))
        cells, mass, loss = np.zeros(shape, np.intp), np.zeros(shape), np.zeros(shape)
        place = rows[entry], ranks(rows[entry])
        cells[place], mass[place], loss[place] = (
            moved.indices[entry],
            moved.data[entry],
            regret[entry],
        )
        at_start, source = (start[kept], sets_left, relaxed[kept]), origin and origin.pick(kept)
        return cls(*at_start, cells, mass, loss, count, before[kept], source)


@dataclass(frozen=True)
class Choices:
    """P partial choices of the next set: the first `decided` cells of each state are left (`left`) or sensed.

    `relaxed` `[P]` has the undecided cells at their better choice; `lost` is the joint loss of the cells left.
    """

    frontier: Frontier
    decided: int
    state: IndexArray
    left: BoolArray
    relaxed: Array
    lost: Array
    bound: Array

    @classmethod
    def undecided(cls, frontier: Frontier) -> Choices:
        """Nothing decided yet in any state."""
        states, none = np.arange(len(frontier.start)), np.zeros(frontier.cells.shape, bool)
        most = frontier.relaxed
        return cls(frontier, 0, states, none, most, np.zeros(len(states)), most)

    def left_cells(self) -> tuple[IndexArray, IndexArray, Array]:
        """The cells left unsensed: the choice, the cell and the mass there of each.

        Choice p of state s = state[p] leaves the cells at the places where left[p] is True: of cells[s] = (4, 7, 9),
        left[p] = (1, 0, 1) leaves 4 and 9.
        """
        row, place = np.nonzero(self.left)
        state = self.state[row]
        return row, self.frontier.cells[state, place], self.frontier.mass[state, place]

    def left_mass(self) -> sparse.csr_array:
        """`[P, M]`, undetected mass after the set."""
        _, cells, mass = self.left_cells()
        shape = (len(self.left), self.frontier.before.shape[1])
        unsensed = sparse.csr_array((mass, cells, ends_of(self.left.sum(axis=1))), shape=shape)
        missed = self.frontier.missed
        return unsensed if missed is None else unsensed + missed[self.state]

    def left_out(self) -> LeftOut:
        """The same cells, by choice."""
        row, cells, _ = self.left_cells()
        return LeftOut.of(row, cells, self.frontier.before.shape[1])

    def pick(self, kept: IndexArray | BoolArray) -> Choices:
        """The choices `kept`, of the same states."""
        numbers = (part[kept] for part in (self.relaxed, self.lost, self.bound))
        return Choices(self.frontier, self.decided, self.state[kept], self.left[kept], *numbers)

    @property
    def start(self) -> IndexArray:
        """`[P]`, the problem each belongs to."""
        return self.frontier.start[self.state]


@dataclass(frozen=True)
class Origin:
    """The complete choices that B states came from: state s is row `place[s]` of `batches[batch[s]]`."""

    batches: list[Choices]
    batch: IndexArray
    place: IndexArray

    @classmethod
    def of(cls, batches: list[Choices]) -> Origin:
        """One state per choice, in order: batches of 2 and 3 rows have batch 0 0 1 1 1 and place 0 1 0 1 2."""
        batch = np.repeat(np.arange(len(batches)), [len(each.state) for each in batches])
        return cls(batches, batch, ranks(batch))

    def pick(self, kept: IndexArray) -> Origin:
        """Where the states `kept` came from."""
        return Origin(self.batches, self.batch[kept], self.place[kept])


@dataclass(frozen=True)
class LeftOut:
    """Cells left unsensed at one step, of many problems or choices.

    Attributes:
        keys: sorted x · M + j of each problem x and cell j.
        num_cells: M.
    """

    keys: IndexArray
    num_cells: int

    @classmethod
    def of(cls, rows: IndexArray, cells: IndexArray, num_cells: int) -> LeftOut:
        """From pairs of problem and cell."""
        return cls(np.sort(rows.astype(np.int64) * num_cells + cells), num_cells)

    def has(self, rows: IndexArray, cells: IndexArray) -> BoolArray:
        """Whether problem `rows` leaves `cells` out, in the shape that the two have together."""
        # With M = 16 the keys of cells 5 and 9 of problem 2 are 37 and 41.
        return among(self.keys, rows * self.num_cells + cells)[1]


def sets_left_out(origin: Origin | None, state: int) -> list[IndexArray]:
    """The cells left unsensed at each step so far, found by going back from batch to batch."""
    steps: list[IndexArray] = []
    while origin is not None:
        choices, row = origin.batches[origin.batch[state]], origin.place[state]
        frontier, state = choices.frontier, int(choices.state[row])
        steps.insert(0, frontier.cells[state][choices.left[row]])
        origin = frontier.origin
    return steps
