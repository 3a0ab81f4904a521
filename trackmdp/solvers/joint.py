"""What branch and bound has open: info states with cells to decide on, and partial choices of their next set.

What cells left unsensed lose together, those decided on and those that are not: the bound inside branch and bound.

Let D be the cells left unsensed and U those still undecided, z the undetected mass. One more set for all of it, then
the position revealed, is worth at most (`Tree._one_more_set`)

    sum_j z_j rho_j + sum_i max{0, sum_j z_j b_ji},   b_ji = P_ji w_i - c_i p_in(j),   w_i = r + V(i) - R(i),

rho_j = sum_i P_ji R(i): sensing i next gains w_i where the target goes on to i, and costs c_i wherever it comes from.
With S_i = sum_{j in D} z_j b_ji, what a cell k of U adds depends on D: where S_i > 0, sensor i will be on and k pays
for it; where S_i < 0, k alone has to make it worth while. Dividing S_i among the cells of U, each with a share
s_ik >= 0 and sum_k s_ik <= 1, max{0, a + b} <= max{0, a} + max{0, b} gives

    max{0, S_i + sum_k z_k b_ki} <= max{0, S_i} + sum_k [max{0, s_ik S_i + z_k b_ki} - max{0, s_ik S_i}],

a sum over the cells of U, in which each is decided by itself. Shares in proportion to |z_k b_ki|, over the k whose sign
is opposite to that of S_i, make cell k lose |z_k b_ki| min{1, |S_i| / sum_k |z_k b_ki|} at i.

Two cells, each of mass 1, that lead to different next cells with w = 1 and c = .3: b = .7 at the own next cell, -.3 at
the other one. With the first left, S = (.7, -.3), and the second has to pay .3 for the first's sensor and loses .3 at
its own: alone it would gain .7, now .1; left together they gain .8 = 2 (.7 - .3).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from trackmdp.solvers.renewal import IndexArray, row_index
from trackmdp.world.model import Array, BoolArray, World

MOST_ENTRIES = 1 << 15
"""Entries b_ji handled at once: what is a quarter of a megabyte stays in the cache."""
WIDEST = 1 << 13
"""Pairs (cell, next cell) of one state above which it is not looked at: the sums would take longer than they save."""


@dataclass(frozen=True)
class Next:
    """Where the target may go on to from the cells of B states.

    Attributes:
        cells: `[B, I]`, the cells that can be reached, padded with M.
        place: `[B, K, Z]`, place among `cells` of each of the Z moves out of each of the K cells of a state.
    """

    cells: IndexArray
    place: IndexArray


class Joint:
    """Losses against revealing the position at once, for many partial choices.

    Args:
        world: the problem.
        detected: `[M]`, worth of sensing the target in each cell, r + V.
        revealed: R_0 ... R_{H-1}, each `[M]`.
    """

    def __init__(self, world: World, detected: Array, revealed: list[Array]) -> None:
        kernel, m = world.kernel, world.num_cells
        count = np.diff(kernel.indptr)
        rows = np.repeat(np.arange(m), count)
        column = np.arange(kernel.nnz) - np.repeat(kernel.indptr[:-1], count)
        # Cell M stands for no cell: a move to it has probability 0, its sensor costs and gains nothing.
        self._to, self._p = np.full((m + 1, count.max(initial=0)), m), np.zeros((m + 1, count.max(initial=0)))
        self._to[rows, column], self._p[rows, column] = kernel.indices, kernel.data
        self._inside, self._cost = np.append(world.stay_probability, 0.0), np.append(world.cost, 0.0)
        self._revealed = [np.append(known, 0.0) for known in revealed]
        self._detected = np.append(detected, 0.0)

    def next(self, cells: IndexArray, present: BoolArray) -> Next | None:
        """Where the states with `cells` `[B, K]` go on to; None where that is too much to be worth it."""
        none = len(self._to) - 1
        to = self._to[np.where(present, cells, none)]
        flat = to.reshape(len(to), -1)
        # Ranks within each row: (7, 3, 7, 4) is sorted to (3, 4, 7, 7) with ranks 0 1 2 2, so places 2 0 2 1.
        order = np.argsort(flat, axis=1, kind="stable")
        ranked = np.take_along_axis(flat, order, axis=1)
        rank = np.zeros_like(ranked)
        np.cumsum(ranked[:, 1:] != ranked[:, :-1], axis=1, out=rank[:, 1:])
        width = int(rank.max(initial=0)) + 1
        if cells.shape[1] * width > WIDEST:
            return None
        place = np.empty_like(rank)
        np.put_along_axis(place, order, rank, axis=1)
        reached = np.full((len(to), width), none)
        np.put_along_axis(reached, rank, ranked, axis=1)
        return Next(reached.astype(np.int32), place.reshape(to.shape).astype(np.int16))

    def losses(
        self,
        after: Next,
        cells: IndexArray,
        mass: Array,
        sets_left: int,
        state: IndexArray,
        left: BoolArray,
        decided: int,
    ) -> tuple[Array, Array]:
        """What the cells left lose, and what each undecided one would add to it at least if it were left as well.

        Args:
            after: of the states.
            cells: `[B, K]`, where each state's target may be.
            mass: `[B, K]`, with which probability.
            sets_left: sets after the one that is decided on, at least 1.
            state: `[P]`, of each choice.
            left: `[P, K]`, the cells left unsensed.
            decided: the first cells of each state, which are decided on.

        Returns:
            `[P]` and `[P, K - decided]`; either may be negative, for against revealing the position at once one more
            set may look better than it is.
        """
        size = max(1, MOST_ENTRIES // max(1, left.shape[1] * after.cells.shape[1]))
        lost, added = np.zeros(len(state)), np.zeros((len(state), left.shape[1] - decided))
        for first in range(0, len(state), size):
            part = slice(first, first + size)
            known, where = np.unique(state[part], return_inverse=True)
            chosen = Next(after.cells[known], after.place[known])
            lost[part], added[part] = self._part(
                chosen, cells[known], mass[known], sets_left, where, left[part], decided
            )
        return lost, added

    def _part(
        self,
        after: Next,
        cells: IndexArray,
        mass: Array,
        sets_left: int,
        where: IndexArray,
        left: BoolArray,
        decided: int,
    ) -> tuple[Array, Array]:
        ends, known = self._revealed[sets_left - 1], self._revealed[sets_left]
        to, place = self._to[cells], after.place.astype(np.intp)
        moved = mass[:, :, None] * self._p[cells]
        # z_j b_ji, [B, K, I]: the price of every next cell, and the gain at those that j leads to
        gain = (mass * -self._inside[cells])[:, :, None] * self._cost[after.cells][:, None, :]
        state, cell = np.ogrid[: len(cells), : cells.shape[1]]
        gain[state[:, :, None], cell[:, :, None], place] += moved * (self._detected - ends)[to]
        # R_{h-1} z less the linear part of one more set: what revealing is worth more where nothing is sensed next
        revealed = mass * known[cells] - (moved * ends[to]).sum(axis=2)
        size = np.abs(gain)
        each = gain[where]  # [P, K, I]
        summed = np.matmul(left[:, None, :].astype(float), each)[:, 0]
        lost = (left * revealed[where]).sum(axis=1) - np.maximum(summed, 0.0).sum(axis=1)
        # sums over the undecided cells of what is positive and of what is negative, [B, I]
        total, whole = gain[:, decided:].sum(axis=1), size[:, decided:].sum(axis=1)
        opposite = np.where(summed > 0, (0.5 * (whole - total))[where], (0.5 * (whole + total))[where])
        most = np.maximum(np.abs(summed), opposite)
        # min{1, |S_i| / sum}, with the sign of S_i
        share = np.divide(summed, most, out=np.zeros_like(summed), where=most > 0)
        # |b| share where the signs differ, and nothing where they agree: (|b| |share| - b share) / 2
        open_ = each[:, decided:]
        shared = np.matmul(open_, -share[:, :, None])[:, :, 0]
        shared += np.matmul(size[where, decided:], np.abs(share)[:, :, None])[:, :, 0]
        # one cell by itself: one more set may look better than R, which is exact
        alone = np.maximum(gain[:, decided:], 0.0).sum(axis=2) - revealed[:, decided:]
        return lost, 0.5 * shared - alone[where]


@dataclass(frozen=True)
class Frontier:
    """B info states whose next set is to be chosen, with the K cells (padded) where leaving might pay.

    Attributes:
        start: `[B]`, the problem (located cell) they belong to.
        sets_left: sets still to be chosen, the next one included.
        relaxed: `[B]`, earned so far plus the bound on the rest with every cell at its better choice.
        cells, mass, regret: `[B, K]`; `mass` is what sensing locates, `regret` what it costs against the bound on
            leaving.
        before: `[B, M]`, undetected mass before the target moves.
        missed: `[B, M]`, mass that all sensors together would miss; None where no sensor misses.
        count: `[B]`, cells that are not padding.
        rest: `[B, K + 1]`, least that the cells from the k-th on take away from `relaxed`.
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
    rest: Array
    before: sparse.csr_array
    missed: sparse.csr_array | None
    after: Next | None
    origin: Origin | None

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
        """The states `kept`, with the entries of `moved` whose `regret` is positive, the likeliest first."""
        # The entries of `moved` are a ragged table: row s has count[s] of them. They are set into rectangles [B, K];
        # the column of an entry is its number among those of its row: rows (0, 0, 2) have columns (0, 1, 0).
        # place[s] is the row of state s in the new batch, -1 for one that is not kept.
        place = np.full(len(start), -1)
        place[kept] = np.arange(len(kept))
        rows = place[row_index(moved)]
        entry = np.flatnonzero((regret > 0) & (rows >= 0))
        # a cell whose regret is not positive is sensed in every choice, and is not decided on
        entry = entry[np.lexsort((-moved.data[entry], rows[entry]))]
        count = np.bincount(rows[entry], minlength=len(kept))
        column = np.arange(len(entry)) - np.repeat(np.cumsum(count) - count, count)
        shape = (len(kept), int(count.max(initial=0)))
        cells, mass, loss = np.zeros(shape, dtype=np.intp), np.zeros(shape), np.zeros(shape)
        cells[rows[entry], column] = moved.indices[entry]
        mass[rows[entry], column] = moved.data[entry]
        loss[rows[entry], column] = regret[entry]
        source = None if origin is None else origin.pick(kept)
        states = start[kept], sets_left, relaxed[kept], cells, mass, loss, count, np.zeros((shape[0], shape[1] + 1))
        return cls(*states, before[kept], None, None, source)


@dataclass(frozen=True)
class Choices:
    """P partial choices of the next set: the first `decided` cells of each state are left (`left`) or sensed.

    `relaxed` `[P]` has the undecided cells at their better choice; `lost` is what those left lose together.
    """

    frontier: Frontier
    decided: int
    state: IndexArray
    left: BoolArray
    relaxed: Array
    lost: Array
    bound: Array

    @classmethod
    def undecided(cls, frontier: Frontier, bound: Array) -> Choices:
        """Nothing decided yet in any state."""
        states, none = np.arange(len(frontier.start)), np.zeros(frontier.cells.shape, dtype=bool)
        return cls(frontier, 0, states, none, frontier.relaxed, np.zeros(len(states)), bound)

    def left_cells(self) -> tuple[IndexArray, IndexArray, Array]:
        """The cells left unsensed: the choice, the cell and the mass there of each.

        Choice p of state s = state[p] leaves the cells at the places where left[p] is True: of cells[s] = (4, 7, 9),
        left[p] = (1, 0, 1) leaves 4 and 9.
        """
        row, place = np.nonzero(self.left)
        state = self.state[row]
        return row, self.frontier.cells[state, place], self.frontier.mass[state, place]

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
        sizes = [len(each.state) for each in batches]
        return cls(batches, np.repeat(np.arange(len(sizes)), sizes), np.concatenate([np.arange(n) for n in sizes]))

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
        # With M = 16 and the keys 37, 41 (cells 5 and 9 of problem 2), (2, 9) gives 41: found at place 1; (2, 6) gives
        # 38: place 1 as well, another key. `minimum` is for keys beyond the last one, whose place is the length.
        wanted = rows * self.num_cells + cells
        place = np.minimum(np.searchsorted(self.keys, wanted), max(len(self.keys) - 1, 0))
        return self.keys[place] == wanted if len(self.keys) else np.zeros(wanted.shape, dtype=bool)


def sets_left_out(origin: Origin | None, state: int) -> list[IndexArray]:
    """The cells left unsensed at each step so far, found by going back from batch to batch."""
    steps: list[IndexArray] = []
    while origin is not None:
        choices, row = origin.batches[origin.batch[state]], origin.place[state]
        frontier, state = choices.frontier, int(choices.state[row])
        steps.insert(0, frontier.cells[state][choices.left[row]])
        origin = frontier.origin
    return steps
