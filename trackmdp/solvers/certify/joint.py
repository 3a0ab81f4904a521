"""Joint loss of cells left unsensed, decided on or undecided: the bound inside branch and bound.

Let D be the cells left unsensed and U those still undecided, z the undetected mass. One more set for all of it, then
the position revealed, is worth at most (`Losses.one_more_set`)

    sum_j z_j rho_j + sum_i max{0, sum_j z_j b_ji},   b_ji = P_ji w_i - c_i p_in(j),   w_i = r + V(i) - R(i),

rho_j = sum_i P_ji R(i): sensing i next gains w_i where the target goes on to i, and costs c_i wherever it comes from.
With S_i = sum_{j in D} z_j b_ji, the addition of a cell k of U depends on D: where S_i > 0, sensor i will be on and k
pays for it; where S_i < 0, k alone has to make it worth while. Dividing S_i among the cells of U, each with a share
s_ik >= 0 and sum_k s_ik <= 1, max{0, a + b} <= max{0, a} + max{0, b} gives

    max{0, S_i + sum_k z_k b_ki} <= max{0, S_i} + sum_k [max{0, s_ik S_i + z_k b_ki} - max{0, s_ik S_i}],

a sum over the cells of U, in which each is decided by itself. Shares in proportion to |z_k b_ki|, over the k of sign
opposite to S_i, make cell k lose |z_k b_ki| min{1, |S_i| / sum_k |z_k b_ki|} at i.

Two cells, each of mass 1, that lead to different next cells with w = 1 and c = .3: b = .7 at the own next cell, -.3 at
the other one. With the first left, S = (.7, -.3), and the second has to pay .3 for the first's sensor and loses .3 at
its own: alone it would gain .7, now .1; left together they gain .8 = 2 (.7 - .3).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trackmdp.arrays.entries import padded_rows
from trackmdp.arrays.types import Array, BoolArray, IndexArray
from trackmdp.world.model import World

MOST_ENTRIES = 1 << 15
"""Entries b_ji handled at once: a quarter of a megabyte stays in the cache."""
_WIDEST = 1 << 13
"""Pairs (cell, next cell) of one state above which it is not looked at: the sums would take longer than they save."""


@dataclass(frozen=True)
class Next:
    """Where the target may go on to from the K cells of each of B states.

    Attributes:
        start: `[B, K]`, these cells.
        mass: `[B, K]`, with which probability it is there.
        cells: `[B, I]`, the cells that can be reached, padded with M.
        place: `[B, K, Z]`, place among `cells` of each of the Z moves out of each of the K cells of a state.
    """

    start: IndexArray
    mass: Array
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
        # Cell M stands for no cell: a move to it has probability 0, its sensor costs and gains nothing.
        self._to, self._p = padded_rows(world.kernel, world.num_cells, more=1)
        self._inside = np.append(world.stay_probability, 0.0)
        self._cost = np.append(world.prices, 0.0)
        self._revealed = [np.append(known, 0.0) for known in revealed]
        self._detected = np.append(detected, 0.0)

    def next(self, cells: IndexArray, mass: Array, present: BoolArray) -> Next | None:
        """Where states go on to, by their cells `present`; None where that is too much to be worth it."""
        none = len(self._to) - 1
        to = self._to[np.where(present, cells, none)]
        flat = to.reshape(len(to), -1)
        # Ranks within each row: (7, 3, 7, 4) is sorted to (3, 4, 7, 7) with ranks 0 1 2 2, so places 2 0 2 1.
        order = np.argsort(flat, axis=1, kind="stable")
        ranked = np.take_along_axis(flat, order, axis=1)
        rank = np.zeros_like(ranked)
        np.cumsum(ranked[:, 1:] != ranked[:, :-1], axis=1, out=rank[:, 1:])
        width = int(rank.max(initial=0)) + 1
        if cells.shape[1] * width > _WIDEST:
            return None
        place = np.empty_like(rank)
        np.put_along_axis(place, order, rank, axis=1)
        reached = np.full((len(to), width), none)
        np.put_along_axis(reached, rank, ranked, axis=1)
        place = place.reshape(to.shape).astype(np.int16)
        return Next(cells, mass, reached.astype(np.int32), place)

    def losses(
        self, after: Next, sets_left: int, state: IndexArray, left: BoolArray, decided: int
    ) -> tuple[Array, Array]:
        """Loss of the cells left, and the least addition of each undecided cell if it were left as well.

        Args:
            after: of the states.
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
            chosen = Next(*(each[known] for each in vars(after).values()))
            lost[part], added[part] = self._part(chosen, sets_left, where, left[part], decided)
        return lost, added

    def _part(
        self, after: Next, sets_left: int, where: IndexArray, left: BoolArray, decided: int
    ) -> tuple[Array, Array]:
        cells, mass = after.start, after.mass
        ends, known = self._revealed[sets_left - 1], self._revealed[sets_left]
        to, place = self._to[cells], after.place.astype(np.intp)
        moved = mass[:, :, None] * self._p[cells]
        # z_j b_ji, [B, K, I]: the price of every next cell, and the gain at the successors of j
        gain = (mass * -self._inside[cells])[:, :, None] * self._cost[after.cells][:, None, :]
        state, cell = np.ogrid[: len(cells), : cells.shape[1]]
        gain[state[:, :, None], cell[:, :, None], place] += moved * (self._detected - ends)[to]
        # R_{h-1} z less the linear part of one more set: worth of revealing where nothing is sensed next
        revealed = mass * known[cells] - (moved * ends[to]).sum(axis=2)
        size = np.abs(gain)
        each = gain[where]  # [P, K, I]
        summed = np.matmul(left[:, None, :].astype(float), each)[:, 0]
        lost = (left * revealed[where]).sum(axis=1) - np.maximum(summed, 0.0).sum(axis=1)
        # sums of the positive and of the negative terms over the undecided cells, [B, I]
        total, whole = gain[:, decided:].sum(axis=1), size[:, decided:].sum(axis=1)
        opposite = np.where(
            summed > 0, (0.5 * (whole - total))[where], (0.5 * (whole + total))[where]
        )
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
