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

The loss against revealing at once is superadditive, so the joint loss of two cells, when both are left, bounds the loss
of any set of undecided cells (`Tree._least_loss`).

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
from trackmdp.solvers.certify.joint import Joint

# Choices under one heap entry: enough of them for array arithmetic to pay, and not so many that poor ones are expanded
# along with the best one, which gives the batch its place in the heap.
LARGEST_BATCH = 4096
# Complete choices that go on to the next step together.
ENOUGH = 1024
# Finite on purpose: regrets are summed and their maximum is taken out again (`_least_loss`), and inf - inf is nan.
FORBIDDEN = 1e30
MOST_PAIRED = 10
"""Cells of one state up to which every pair is looked at for a better bound."""


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
        self._detected = problem.detected
        self._windowed = problem.windowed
        self._revealed, self._slack, self._delayed = revealed, slack, delayed
        self._joint = Joint(problem.world, problem.detected, revealed)
        self.best = lower.copy()
        self.nodes = 0
        # Problem -> cells left unsensed at each step, for the problems with a better plan than `lower`.
        self._leaves: dict[int, list[IndexArray]] = {}
        self._heap: list[tuple[float, int, Choices]] = []
        # Sets left -> complete choices that wait until there are enough of them: arrays of a few rows are slow.
        self._complete: dict[int, list[Choices]] = {}
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
        return not self._heap and not self._complete

    def _open_choices(self) -> Iterator[Choices]:
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
            origin = frontier.origin
            before = np.zeros(len(frontier.start))
            for number, batch in enumerate(origin.batches if origin is not None else ()):
                assert origin is not None
                mine = origin.batch == number
                before[mine] = self._paid(batch, paid, known)[origin.place[mine]]
            if frontier.missed is not None:
                before = before + frontier.missed @ paid
            known[id(frontier)] = before
        on_left = frontier.mass * paid[frontier.cells]
        return before[choices.state] + (choices.left * on_left[choices.state]).sum(axis=1)

    def run(self, go_on: Callable[[Tree], bool]) -> None:
        """Expand open choices, best first, while there are any and `go_on(self)` holds."""
        while not self.closed and go_on(self):
            if self._heap:
                self._decide(heapq.heappop(self._heap)[2])
            for sets_left, batches in list(self._complete.items()):
                if not self._heap or sum(len(each.state) for each in batches) >= ENOUGH:
                    del self._complete[sets_left]
                    self._advance(batches)

    def improvements(self) -> tuple[BoolArray, list[LeftOut]]:
        """`[B]` which problems have found a better plan, and the cells that it leaves unsensed at each step."""
        better = np.zeros(len(self.best), dtype=bool)
        better[list(self._leaves)] = True
        found = []
        for t in range(len(self._revealed)):
            cells = [plan[t] for plan in self._leaves.values()]
            rows = np.repeat(
                np.array(list(self._leaves), dtype=np.int64), [len(left) for left in cells]
            )
            found.append(
                LeftOut.of(
                    rows, np.concatenate([[], *cells]).astype(np.int64), self._world.num_cells
                )
            )
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
        raw, added = self._losses(split)
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
            apart = relaxed - lost - frontier.rest[split.state, k + 1]
            bound = np.minimum(split.bound, np.minimum(apart, together - (paid - least[:, 0])))
            self._push(Choices(frontier, k + 1, split.state, cells, relaxed, lost, bound))

    def _losses(self, choices: Choices) -> tuple[Array, Array]:
        """`[P]` joint loss of the cells left, `[P, K - k]` the addition of each undecided cell if it is left."""
        frontier, k = choices.frontier, choices.decided
        lost = choices.lost.copy()
        added = np.zeros((len(choices.state), frontier.cells.shape[1] - k))
        some = np.flatnonzero(choices.left.any(axis=1))
        if not len(some):
            return lost, added
        if frontier.after is None:
            lost[some] = self._joint_loss(choices.pick(some))
            return lost, added
        of = frontier.after, frontier.sets_left - 1
        lost[some], added[some] = self._joint.losses(
            *of, choices.state[some], choices.left[some], k
        )
        return lost, added

    def _joint_loss(self, choices: Choices) -> Array:
        """`[P]` lower bound on the loss of leaving the cells left unsensed against revealing the position at once."""
        return self._loss(self._left_mass(choices), choices.frontier.sets_left - 1)

    def _loss(self, mass: sparse.csr_array, sets_left: int) -> Array:
        """`[P]` worth of `mass` with the position revealed at once, less its bound with one more set before that."""
        # Revealed at once, the mass is worth sum_j z_j R(e_j); one set for all, revealed only then, is worth less:
        # with z = (.2 at a, .2 at b) and the target going on to c from either, one sensor at c serves both; if it goes
        # on to different cells, two sensors are paid for .4 of mass in place of one each for .2.
        return np.maximum(
            mass @ self._revealed[sets_left] - self._one_more_set(mass, sets_left)[0], 0.0
        )

    def _least_loss(self, frontier: Frontier) -> Array:
        """`[B, K + 1]` lower bound on the loss against `relaxed` of the cells from the k-th on, however decided.

        A cell sensed costs its regret. Two or more cells left unsensed lose, F being sublinear, at least the sum over
        them of half the smallest loss of a pair with that cell. With one or none left, all others cost their regret.
        """
        count, width = len(frontier.start), frontier.cells.shape[1]
        if not 2 <= width <= MOST_PAIRED:
            return np.zeros((count, width + 1))
        # pair[s, a, b]: joint loss of cells a and b of state s when both are left; infinite where one is padding
        pair = np.full((count, width, width), np.inf)
        for shift in range(1, width):
            state, place = np.nonzero(np.arange(shift, width) < frontier.count[:, None])
            lost = self._pair_loss(frontier, state, place, place + shift)
            pair[state, place, place + shift] = pair[state, place + shift, place] = lost
        rest = np.zeros((count, width + 1))
        present = np.arange(width) < frontier.count[:, None]
        for k in range(width):
            # Each cell from the k-th on costs its regret, or is left together with another one. Averaging over all
            # pairings of the cells left, cell a takes at least half of its cheapest pair's loss.
            # That holds where two or more are left; with one or none, all the others cost their regret.
            later = pair[:, k:, k:].min(axis=2)
            regret = np.where(present[:, k:], frontier.regret[:, k:], 0.0)
            # Why half, with n cells left: z_N is 1/(n-1) times the sum of its pairs, and the loss is superadditive and
            # homogeneous, so loss(z_N) >= 1/(n-1) sum over pairs of loss(a, b) >= sum over a of min_b loss(a, b) / 2.
            several = np.where(present[:, k:], np.minimum(later / 2.0, regret), 0.0).sum(axis=1)
            # One cell left: all others cost their regret, at best all but the largest.
            rest[:, k] = np.minimum(several, regret.sum(axis=1) - regret.max(axis=1))
        return rest

    def _pair_loss(
        self, frontier: Frontier, state: IndexArray, a: IndexArray, b: IndexArray
    ) -> Array:
        cells = np.stack([frontier.cells[state, a], frontier.cells[state, b]], axis=1)
        masses = np.stack([frontier.mass[state, a], frontier.mass[state, b]], axis=1)
        # CSR rows of exactly two entries each: row p is entries 2p and 2p + 1.
        pointer = np.arange(len(state) + 1) * 2
        mass = sparse.csr_array(
            (masses.ravel(), cells.ravel(), pointer), shape=(len(state), self._world.num_cells)
        )
        return self._loss(mass, frontier.sets_left - 1)

    def _left_mass(self, choices: Choices) -> sparse.csr_array:
        _, cells, mass = choices.left_cells()
        pointer = np.concatenate([[0], np.cumsum(choices.left.sum(axis=1))])
        shape = (len(choices.left), self._world.num_cells)
        unsensed = sparse.csr_array((mass, cells, pointer), shape=shape)
        missed = choices.frontier.missed
        return unsensed if missed is None else unsensed + missed[choices.state]

    def _one_more_set(
        self, mass: sparse.csr_array, sets_left: int
    ) -> tuple[Array, sparse.csr_array, Array, Array]:
        """Upper bound of F on each row of `mass` `[P, M]`: one more set for all of it, then the position is revealed.

        Returns:
            `[P]` the bound; `[P, M]` the mass after the move; and per stored entry of it, the worth of sensing the cell
            and of leaving it.
        """
        # Row q of `mass` [P, M] is a vector of undetected mass, `moved` is q P. Revealed after this set, each cell
        # counts by itself, m_j (p_d (r + V(j)) + (1 - p_d) R_{h-1}(j)) - c_j |m| or m_j R_{h-1}(j), and the best set
        # takes the larger one cell by cell.
        moved = mass @ self._world.kernel
        rows, cells = row_index(moved), moved.indices
        detected, missed = self._detected[cells], self._revealed[sets_left - 1][cells]
        worth = detected - (1.0 - self._world.detects(cells)) * (detected - missed)
        sense = (
            moved.data * worth
            - self._world.prices[cells] * per_row(rows, moved.data, mass.shape[0])[rows]
        )
        leave = moved.data * missed
        return per_row(rows, np.maximum(sense, leave), mass.shape[0]), moved, sense, leave

    def _advance(self, batches: list[Choices]) -> None:
        """The sets of these choices are complete: go on to the next step, or value the chain if there is none."""
        batches = [each.pick(self._hopeful(each.start, each.bound)) for each in batches]
        if not any(len(each.state) for each in batches):
            return
        sets_left = batches[0].frontier.sets_left - 1
        mass = sparse.vstack([self._left_mass(each) for each in batches], format="csr")
        earned = (
            np.concatenate([each.relaxed for each in batches]) - mass @ self._revealed[sets_left]
        )
        # `relaxed` counted the cells left at their revealed worth; that is taken out and the rest searched for anew
        most = np.concatenate([each.bound for each in batches])
        if self._delayed is not None and sets_left > 1:
            most = np.minimum(
                most, earned + np.concatenate([self._left_worth(each) for each in batches])
            )
        start = np.concatenate([each.start for each in batches])
        self._open(start, earned, mass, sets_left, most, Origin.of(batches))

    def _left_worth(self, choices: Choices) -> Array:
        """`[P]` upper bound on the worth of the mass that complete `choices` leave undetected."""
        assert self._delayed is not None
        row, cells, _ = choices.left_cells()
        left = LeftOut.of(row, cells, self._world.num_cells)
        before = choices.frontier.before[choices.state]
        return self._delayed.worth(before, left, choices.frontier.sets_left - 1)

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
        _, moved, sense, leave = self._one_more_set(mass, sets_left)
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
        present = np.arange(frontier.cells.shape[1]) < frontier.count[:, None]
        at = frontier.cells, frontier.mass, present
        after = self._joint.next(*at) if self._world.perfect else None
        frontier = replace(frontier, rest=self._least_loss(frontier), after=after)
        first = Choices.undecided(frontier, frontier.relaxed - frontier.rest[:, 0])
        if frontier.missed is not None:  # the missed mass has this loss under every choice
            lost = self._joint_loss(first)
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
