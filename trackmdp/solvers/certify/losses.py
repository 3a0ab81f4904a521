"""Losses of cells left unsensed, against revealing the position at once: the bounds inside branch and bound."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import sparse

from trackmdp.arrays.entries import per_row, row_index
from trackmdp.arrays.types import Array
from trackmdp.solvers.certify.choices import Choices, Frontier
from trackmdp.solvers.certify.inner import InnerProblem
from trackmdp.solvers.certify.joint import Joint


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
        """The states with where the target may go on to."""
        if not self._world.perfect:
            return frontier
        after = self._joint.next(frontier.cells, frontier.mass, frontier.present)
        return replace(frontier, after=after)

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
