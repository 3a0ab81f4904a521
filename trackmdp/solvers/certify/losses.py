"""Losses of cells left unsensed, against revealing the position at once: the bounds inside branch and bound.

The loss is superadditive, so the joint loss of two cells, when both are left, bounds the loss of any set of undecided
cells (`Losses._least`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import sparse

from trackmdp.arrays.entries import per_row, row_index
from trackmdp.arrays.types import Array, IndexArray
from trackmdp.solvers.certify.choices import Choices, Frontier
from trackmdp.solvers.certify.inner import InnerProblem
from trackmdp.solvers.certify.joint import Joint

MOST_PAIRED = 10
"""Cells of one state up to which every pair is looked at for a better bound."""


class Losses:
    """Losses of choices, given R_0 ... R_{H-1}.

    Args:
        problem: worth of seeing the target in each cell.
        revealed: R_0 ... R_{H-1}, each `[M]`.
    """

    def __init__(self, problem: InnerProblem, revealed: list[Array]) -> None:
        self._world, self._detected, self._revealed = problem.world, problem.detected, revealed
        self._joint = Joint(problem.world, problem.detected, revealed)

    def looked_ahead(self, frontier: Frontier) -> Frontier:
        """The states with where the target may go on to, and with the least losses that are to come."""
        after = None
        if self._world.perfect:
            after = self._joint.next(frontier.cells, frontier.mass, frontier.present)
        return replace(frontier, rest=self._least(frontier), after=after)

    def of(self, choices: Choices) -> tuple[Array, Array]:
        """`[P]` joint loss of the cells left, `[P, K - k]` the addition of each undecided cell if it is left."""
        frontier, k = choices.frontier, choices.decided
        lost = choices.lost.copy()
        added = np.zeros((len(choices.state), frontier.cells.shape[1] - k))
        some = np.flatnonzero(choices.left.any(axis=1))
        if not len(some):
            return lost, added
        if frontier.after is None:
            lost[some] = self.joint(choices.pick(some))
            return lost, added
        of = frontier.after, frontier.sets_left - 1
        lost[some], added[some] = self._joint.losses(
            *of, choices.state[some], choices.left[some], k
        )
        return lost, added

    def joint(self, choices: Choices) -> Array:
        """`[P]` lower bound on the loss of leaving the cells left unsensed against revealing the position at once."""
        return self._loss(choices.left_mass(), choices.frontier.sets_left - 1)

    def _loss(self, mass: sparse.csr_array, sets_left: int) -> Array:
        """`[P]` worth of `mass` with the position revealed at once, less its bound with one more set before that."""
        # Revealed at once, the mass is worth sum_j z_j R(e_j); one set for all, revealed only then, is worth less:
        # with z = (.2 at a, .2 at b) and the target going on to c from either, one sensor at c serves both; if it goes
        # on to different cells, two sensors are paid for .4 of mass in place of one each for .2.
        return np.maximum(
            mass @ self._revealed[sets_left] - self.one_more_set(mass, sets_left)[0], 0.0
        )

    def one_more_set(
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

    def _least(self, frontier: Frontier) -> Array:
        """`[B, K + 1]` lower bound on the loss against `relaxed` of the cells from the k-th on, however decided.

        A cell sensed costs its regret. Two or more cells left unsensed lose, F being sublinear, at least the sum over
        them of half the smallest loss of a pair with that cell. With one or none left, all others cost their regret.
        """
        count, width = len(frontier.start), frontier.cells.shape[1]
        if not 2 <= width <= MOST_PAIRED:
            return np.zeros((count, width + 1))
        # pair[s, a, b]: joint loss of cells a and b of state s when both are left; infinite where one is padding
        pair, present = np.full((count, width, width), np.inf), frontier.present
        for shift in range(1, width):
            state, place = np.nonzero(present[:, shift:])
            lost = self._pair(frontier, state, place, place + shift)
            pair[state, place, place + shift] = pair[state, place + shift, place] = lost
        rest = np.zeros((count, width + 1))
        for k in range(width):
            # Each cell from the k-th on costs its regret, or is left together with another one. Averaging over all
            # pairings of the cells left, cell a takes at least half of its cheapest pair's loss.
            # That holds where two or more are left; with one or none, all the others cost their regret.
            later = pair[:, k:, k:].min(axis=2)
            regret = frontier.regret[:, k:]
            # Why half, with n cells left: z_N is 1/(n-1) times the sum of its pairs, and the loss is superadditive and
            # homogeneous, so loss(z_N) >= 1/(n-1) sum over pairs of loss(a, b) >= sum over a of min_b loss(a, b) / 2.
            several = np.minimum(later / 2.0, regret).sum(axis=1)
            # One cell left: all others cost their regret, at best all but the largest.
            rest[:, k] = np.minimum(several, regret.sum(axis=1) - regret.max(axis=1))
        return rest

    def _pair(self, frontier: Frontier, state: IndexArray, a: IndexArray, b: IndexArray) -> Array:
        cells = np.stack([frontier.cells[state, a], frontier.cells[state, b]], axis=1)
        masses = np.stack([frontier.mass[state, a], frontier.mass[state, b]], axis=1)
        # CSR rows of exactly two entries each: row p is entries 2p and 2p + 1.
        pointer = np.arange(len(state) + 1) * 2
        mass = sparse.csr_array(
            (masses.ravel(), cells.ravel(), pointer), shape=(len(state), self._world.num_cells)
        )
        return self._loss(mass, frontier.sets_left - 1)
