"""Best-first branch and bound for the search for a moving target, from many located cells at once.

F_h(z) is the largest expected reward of h more sets for undetected mass z, the value V of being located given. It is a
maximum of linear functions of z (one per sequence of sets), so F_h(z) <= sum_j z_j F_h(e_j), where the position is
revealed *once*, after any step. With m = zP and R_h(j) = F_h(e_j), two facts about the next set follow:

* a cell for which sensing is worth more than leaving it alone, m_j (r + V(j)) - c_j sum(m) >= m_j R_{h-1}(j), is
  sensed;
* leaving the cells N unsensed and sensing all others is worth at most the gain of the sensed cells plus the lesser of
  two bounds on the mass z_N left: the position revealed at once, R_{h-1} z_N, or revealed after one more set chosen for
  all of it.

A sensor that is on misses a share 1 - p_d(j) of its mass. Sensing j is then worth p_d m_j (r + V(j)) +
(1 - p_d) m_j R_{h-1}(j) - c_j sum(m), and the mass left after the set is the mass missed even with every sensor on,
(1 - p_d) m, plus p_d m of the cells left unsensed: both facts hold for the sum of these two parts.

Where `delayed` has tables, complete sets are bounded by positions revealed one move late as well.

Cells are decided one by one, the likeliest first; open choices are kept best first in batches, so that all the
arithmetic is on arrays and sparse rows.
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from scipy import sparse

from trackmdp.arrays.entries import per_row, row_index, with_data
from trackmdp.arrays.types import Array, BoolArray, IndexArray
from trackmdp.solvers.certify.choices import Choices, Frontier, LeftOut, Origin, sets_left_out
from trackmdp.solvers.certify.delayed import Delayed
from trackmdp.solvers.certify.inner import InnerProblem
from trackmdp.solvers.certify.losses import Losses

# Choices under one heap entry: enough of them for array arithmetic to pay, and not so many that poor ones are expanded
# along with the best one, which gives the batch its place in the heap.
LARGEST_BATCH = 4096
# Complete choices that go on to the next step together.
ENOUGH = 1024
# Finite on purpose: regrets are summed and their maximum is taken out again (`Losses`), and inf - inf is nan.
FORBIDDEN = 1e30


class Tree:
    """The open choices for F_H from every located cell x, given R_0 ... R_{H-1} (upper bounds of F_h(e_j)).

    Attributes:
        best: `[B]`, worth of the best chain found, or the `lower` it started from.
        nodes: choices looked at so far.
    """

    def __init__(
        self,
        problem: InnerProblem,
        revealed: list[Array],
        lower: Array,
        slack: float,
        mass: sparse.csr_array | None = None,
        delayed: Delayed | None = None,
    ) -> None:
        """Start with nothing chosen.

        Args:
            problem: worth of seeing the target in each cell, and whether a window limits the sets.
            revealed: R_0 ... R_{H-1}, each `[M]`; R_0 is exact (what follows the last set).
            lower: `[B]`, worth of a known chain for each problem.
            slack: plans better than the best known by less than this are not looked for.
            mass: `[B, M]`, where the undetected target may be, one problem per row; without it, B = M and row x is e_x.
            delayed: bounds on complete sets, at least as tight as `revealed`.
        """
        self._world = problem.world
        self._windowed = problem.windowed
        self._revealed, self._slack, self._delayed = revealed, slack, delayed
        self._losses = Losses(problem, revealed)
        self.best = lower.copy()
        self.nodes = 0
        # Problem -> cells left unsensed at each step, for the problems with a better plan than `lower`.
        self._leaves: dict[int, list[IndexArray]] = {}
        self._heap: list[tuple[float, int, Choices]] = []
        # Sets left -> complete choices that wait until there are enough of them: arrays of a few rows are slow.
        self._complete: dict[int, list[Choices]] = {}
        # Expanded at the moment: open until all that follow from them are, since Ctrl-C may come between.
        self._in_hand: list[Choices] = []
        self._ticket = itertools.count()
        # Nothing is earned yet, all H sets are to be chosen, and no batch came before.
        start = sparse.eye_array(self._world.num_cells, format="csr") if mass is None else mass
        most = (
            np.full(len(lower), np.inf)
            if delayed is None
            else start @ delayed.revealed[len(revealed)]
        )
        self._open(np.arange(len(lower)), np.zeros(len(lower)), start, len(revealed), most, None)

    @property
    def closed(self) -> bool:
        """Whether no choice is open."""
        return not (self._heap or self._complete or self._in_hand)

    def _open_choices(self) -> Iterator[Choices]:
        yield from self._in_hand
        for _, _, choices in self._heap:
            yield choices
        for batches in self._complete.values():
            yield from batches

    def upper(self) -> Array:
        """`[B]` proved upper bound of F_H."""
        # Discarded choices were worth at most best + slack at the time, and best only grows; open choices have their
        # own bounds. So the bound is valid at any time, also if the search was stopped early.
        bound = self.best + self._slack
        for choices in self._open_choices():
            np.maximum.at(bound, choices.start, choices.bound)
        return bound

    def rate(self, value: Array, paid: Array) -> Array:
        """`[B]` the least e with e(x) >= bound - value(x) - sum_t z_t · paid for each plan of x not ruled out.

        z_t is the undetected mass after the t-th set of a plan, as far as it is decided, and `paid` `[M]` the payment
        for each step that the target is not located; see `optimal`.
        """
        rate = self.best + self._slack - value
        known: dict[int, Array] = {}
        for choices in self._open_choices():
            np.maximum.at(
                rate,
                choices.start,
                choices.bound - value[choices.start] - self._paid(choices, paid, known),
            )
        return rate

    def _paid(self, choices: Choices, paid: Array, known: dict[int, Array]) -> Array:
        """`[P]` sum_t z_t · paid; `known`: the same sum for each frontier, by its id."""
        frontier = choices.frontier
        before = known.get(id(frontier))
        if before is None:
            before = np.zeros(len(frontier.start))
            if (origin := frontier.origin) is not None:
                for number, batch in enumerate(origin.batches):
                    mine = origin.batch == number
                    before[mine] = self._paid(batch, paid, known)[origin.place[mine]]
            if frontier.missed is not None:
                before = before + frontier.missed @ paid
            known[id(frontier)] = before
        on_left = frontier.mass * paid[frontier.cells]
        return before[choices.state] + (choices.left * on_left[choices.state]).sum(axis=1)

    def run(self, go_on: Callable[[Tree], bool]) -> None:
        """Expand open choices, best first, while there are any and `go_on(self)` holds.

        After an interruption it can go on: what was in hand is opened again, and what followed from it stays open.
        """
        for choices in self._in_hand:
            self._push(choices)
        self._in_hand = []
        while not self.closed and go_on(self):
            if self._heap:
                self._in_hand = [self._heap[0][2]]
                self._decide(heapq.heappop(self._heap)[2])
            for sets_left, batches in list(self._complete.items()):
                if not self._heap or sum(len(each.state) for each in batches) >= ENOUGH:
                    self._in_hand = batches
                    del self._complete[sets_left]
                    self._advance(batches)
            self._in_hand = []

    def improvements(self) -> tuple[BoolArray, list[LeftOut]]:
        """`[B]` which problems have found a better plan, and the cells that it leaves unsensed at each step."""
        better, found = np.zeros(len(self.best), bool), []
        problems = np.array(list(self._leaves), np.int64)
        better[problems] = True
        for t in range(len(self._revealed)):
            cells = [plan[t] for plan in self._leaves.values()]
            rows = np.repeat(problems, [len(left) for left in cells])
            left = np.concatenate([[], *cells]).astype(np.int64)
            found.append(LeftOut.of(rows, left, self._world.num_cells))
        return better, found

    def _decide(self, choices: Choices) -> None:
        """Branch on the next undecided cell of every choice; complete choices go on to the next step."""
        # choices that were promising when pushed may be hopeless by the time: the best plans have improved since
        choices = choices.pick(self._hopeful(choices.start, choices.bound))
        frontier, k = choices.frontier, choices.decided
        # States of one batch have different numbers of cells to decide; those with k or fewer are complete.
        done = frontier.count[choices.state] <= k
        if done.any():
            self._complete.setdefault(frontier.sets_left, []).append(choices.pick(done))
        split = choices.pick(~done)
        if not len(split.state):
            return
        self.nodes += 2 * len(split.state)
        raw, added = self._losses.of(split)
        regret = frontier.regret[split.state, k]
        # Each undecided cell costs its regret or its added loss; `together` takes the better of the two for all.
        least = np.minimum(frontier.regret[split.state, k:], added)
        together = split.relaxed - raw - least.sum(axis=1)
        left = split.left.copy()
        left[:, k] = True
        # Two children each: cell k sensed, at the cost of its regret; or left, at the cost of its joint loss with
        # the cells left before it. A child's bound never exceeds its parent's, nor does it pay for the same loss twice.
        for cells, relaxed, lost, paid in (
            (split.left, split.relaxed - regret, split.lost, regret),
            (left, split.relaxed, np.maximum(split.lost, raw + added[:, 0]), added[:, 0]),
        ):
            tighter = np.minimum(relaxed - lost, together - (paid - least[:, 0]))
            bound = np.minimum(split.bound, tighter)
            self._push(Choices(frontier, k + 1, split.state, cells, relaxed, lost, bound))

    def _advance(self, batches: list[Choices]) -> None:
        """The sets of these choices are complete: go on to the next step, or value the chain if there is none."""
        batches = [each.pick(self._hopeful(each.start, each.bound)) for each in batches]
        if not any(len(each.state) for each in batches):
            return
        sets_left = batches[0].frontier.sets_left - 1
        mass = sparse.vstack([each.left_mass() for each in batches], format="csr")
        earned = (
            np.concatenate([each.relaxed for each in batches]) - mass @ self._revealed[sets_left]
        )
        # `relaxed` counted the cells left at their revealed worth; that is taken out and the rest searched for anew
        most = np.concatenate([each.bound for each in batches])
        if self._delayed is not None and sets_left > 1:
            worth = [
                self._delayed.worth(each.frontier.before[each.state], each.left_out(), sets_left)
                for each in batches
            ]
            most = np.minimum(most, earned + np.concatenate(worth))
        start = np.concatenate([each.start for each in batches])
        self._open(start, earned, mass, sets_left, most, Origin.of(batches))

    def _open(
        self,
        start: IndexArray,
        earned: Array,
        mass: sparse.csr_array,
        sets_left: int,
        most: Array,
        origin: Origin | None,
    ) -> None:
        """Put the info states with undetected `mass` on the heap, or close them where one set is left.

        `most` `[P]` bounds the worth of a plan that goes on from them, with the reward `earned` so far.
        """
        _, moved, sense, leave = self._losses.one_more_set(mass, sets_left)
        rows = row_index(moved)
        sense = self._within(start[rows], moved.indices, sense)
        relaxed = earned + per_row(rows, np.maximum(sense, leave), len(start))
        if sets_left == 1:  # the last set is separable: this is its exact value
            # `leave` is m_j R_0(j) here, and R_0 is exact, unlike the bounds R_1 ... used further up.
            self._record(start, relaxed, moved, leave > sense, origin)
            return
        kept = np.flatnonzero(self._hopeful(start, np.minimum(relaxed, most)))
        if not len(kept):
            return
        found = with_data(moved, moved.data * self._world.detects(moved.indices))
        frontier = Frontier.of(start, sets_left, relaxed, mass, found, leave - sense, kept, origin)
        if not self._world.perfect:
            frontier = replace(frontier, missed=(moved - found)[kept])
        frontier = self._losses.looked_ahead(frontier)
        first = Choices.undecided(frontier)
        if frontier.missed is not None:  # the missed mass has this loss under every choice
            lost = self._losses.joint(first)
            first = replace(first, lost=lost, bound=first.bound - lost)
        self._push(replace(first, bound=np.minimum(first.bound, most[kept])))

    def _within(self, start: IndexArray, cells: IndexArray, sense: Array) -> Array:
        """`sense` `[E]`, replaced by a large negative number where the sensor lies outside the window.

        Bounds on later steps do without this: counting such a sensor in only makes them larger, and still bounds.
        """
        allowed = self._world.choosable(start if self._windowed else None, cells)
        return sense if allowed is None else np.where(allowed, sense, -FORBIDDEN)

    def _record(
        self,
        start: IndexArray,
        worth: Array,
        moved: sparse.csr_array,
        left: BoolArray,
        origin: Origin | None,
    ) -> None:
        # best first, so that only the first of many plans for one problem is kept
        order = np.argsort(-worth, kind="stable")
        for place in order[self._hopeful(start[order], worth[order])]:
            x = int(start[place])
            if worth[place] <= self.best[x] + self._slack:
                continue
            self.best[x] = worth[place]
            last = slice(moved.indptr[place], moved.indptr[place + 1])
            self._leaves[x] = [*sets_left_out(origin, int(place)), moved.indices[last][left[last]]]

    def _hopeful(self, start: IndexArray, bound: Array) -> BoolArray:
        return bound > self.best[start] + self._slack

    def _push(self, choices: Choices) -> None:
        choices = choices.pick(self._hopeful(choices.start, choices.bound))
        excess = choices.bound - self.best[choices.start]
        # Sorted by bound - best, not by bound: problems differ in value, and the possible gain of a choice decides.
        order = np.argsort(-excess, kind="stable")
        # A heap of batches, each under its best excess. Of equal ones the batch pushed last comes first, which goes
        # deeper; the ticket also keeps two runs in the same order, and heapq from comparing `Choices`.
        for first in range(0, len(order), LARGEST_BATCH):
            part = order[first : first + LARGEST_BATCH]
            heapq.heappush(
                self._heap, (-float(excess[part[0]]), -next(self._ticket), choices.pick(part))
            )
