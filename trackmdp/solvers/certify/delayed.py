"""Upper bounds on the worth of undetected mass, positions being revealed one move late.

F_h(z) is the largest expected reward of h more sets for undetected mass z (see `branch`). Let the target's cell before
its last move be revealed, but not the move: the mass left is P_i, the moves out of i, without moves to cells just
searched in vain. G_h(i, N) >= F_h of the mass of P_i on N, for each of the 2^Z sets N of successors of i.
With z that mass and the price c_k |z| of each sensor k divided among the cells j of N that lead to k, for any division

    F_h(z) <= sum_j max_L [z_j T_h(j, L) - sum_{k not in L} price_jk],      sum_j price_jk = c_k |z|,
    T_h(j, L) = sum_{k not in L} P_jk (r + V(k)) + G_{h-1}(j, L),           L a set of successors of j, those left.

The reason: the same sensors may be on for all j, at the price of one set; and F_{h-1} is sublinear, so the mass left of
all j together is worth no more than the sum of its parts. This is the Lagrangian of "all j have the same set", with the
prices as multipliers. Shares in proportion to the flow z_j P_jk are close to the best ones, and a few subgradient steps
follow: cells j that want a sensor pay more, the others less. G_1 is exact, as each sensor of the last set is decided by
itself; so is R_2, R_h(j) = max_L [T_h(j, L) - price of the other successors] >= F_h(e_j).

A target in a or in b, .5 each, goes on to k from a with .6. With c_k = .5 the sensor costs .5 for a gain of .3 (r = 1);
if a or b were revealed at once it would cost .25, and pay. Here a bears the whole price, b not leading to k.

A sensor that is on misses a share 1 - p_d, and this share of its mass is left as well.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from trackmdp.arrays.entries import padded_rows, per_row, row_index
from trackmdp.arrays.types import Array, IndexArray
from trackmdp.solvers.certify.choices import LeftOut
from trackmdp.world.model import World

STEPS = 6
"""Subgradient steps. On a walk (c = .3, T_max 3) the tables by themselves leave .059 per step open after one of them,
.056 after six and .055 after forty, of the .19 of the clocked bound."""
_MOST_NUMBERS = 2**18
"""Numbers in one array, 2 MB; one cell of eight successors needs twice as many."""
WIDEST, MOST_WORK = 8, 2e8
"""Successors of a cell, and worths z_j T_h(j, L) of one table, above which the tables are left alone: a second for each
step. With nine successors (512 sets of each) they took longer than the nodes that they saved."""


@dataclass(frozen=True)
class Delayed:
    """The tables of one search, the value of locating the target given.

    Attributes:
        revealed: R_0 ... R_H, each `[M]`: no less than the worth of so many sets from a known position.
        left: G_0 ... G_{H-1}, each `[M, 2^Z]`; bit b of the second index: successor b is left.
        successors: `[M, Z]`, padded with 0.
    """

    revealed: list[Array]
    left: list[Array]
    successors: IndexArray

    @classmethod
    def of(cls, world: World, detected: Array, missed: Array, length: int) -> Delayed | None:
        """The tables for up to `length` sets; None where cells have too many successors.

        A table takes M Z 4^Z products for each step, and 2^Z M numbers.

        Args:
            world: the problem; its window is left out of account, which bounds it from above.
            detected: `[M]`, worth of sensing the target in each cell, r + V.
            missed: `[M]`, R_0.
            length: H, at least 1.
        """
        most = int(np.diff(world.kernel.indptr).max(initial=0))
        if most > WIDEST or world.num_cells * most * 4**most > MOST_WORK:
            return None
        moves = _Moves(world, detected)
        revealed, left = [missed], [moves.none_left(missed)]
        for sets in range(1, length + 1):
            worth = moves.found + left[-1]
            revealed.append((worth - moves.own_price).max(axis=1))
            if sets < length:
                left.append(moves.next_table(worth, revealed[-2], separable=sets == 1))
        return cls(revealed, left, moves.to)

    def worth(self, before: sparse.csr_array, left: LeftOut, sets_left: int) -> Array:
        """`[P]` upper bound of F_h, h being `sets_left`, where `before` `[P, M]` has moved on and `left` is left."""
        rows, cells = row_index(before), before.indices
        to = self.successors[cells]
        sets = left.has(rows[:, None], to) @ (1 << np.arange(to.shape[1]))
        return per_row(rows, before.data * self.left[sets_left][cells, sets], before.shape[0])


class _Moves:
    """The moves out of each cell as rectangles, and the worth found by sets of them.

    Attributes:
        to: `[M, Z]`, the cells moved to, padded with 0.
        found: `[M, 2^Z]`, worth found by sensing the successors that are not left.
        own_price: `[M, 2^Z]`, price of these sensors with the target known to move out of the cell.
    """

    def __init__(self, world: World, detected: Array) -> None:
        self.to, p = padded_rows(world.kernel)
        width = self.to.shape[1]
        self._p, self._there = p, p > 0
        # [2^Z, Z], bit b of the number of a set: with Z = 3, set 5 leaves the successors 0 and 2.
        is_left = (np.arange(2**width)[:, None] >> np.arange(width)) % 2 > 0
        self._sensed = (~is_left).astype(float)
        reports = np.broadcast_to(world.detects(self.to), self.to.shape)
        self._reports, self._detected, self._cost = reports, detected, world.prices
        self._inside = world.stay_probability
        # [M, 2^Z, Z], the mass left at each successor
        self._mass = p[:, None] * (1.0 - self._sensed * reports[:, None])
        self.found = (p * reports * detected[self.to]) @ self._sensed.T
        self.own_price = (
            (self._there * world.prices[self.to]) @ self._sensed.T * self._inside[:, None]
        )

    def none_left(self, missed: Array) -> Array:
        """G_0: `missed` `[M]` is the worth of each position after the last set."""
        return np.einsum("msz,mz->ms", self._mass, missed[self.to])

    def next_table(self, worth: Array, ends: Array, *, separable: bool) -> Array:
        """`[M, 2^Z]` G_h, from `worth` `[M, 2^Z]` T_h and `ends` `[M]` R_{h-1}; `separable`: h is 1."""
        m, sets = worth.shape
        cells = max(1, _MOST_NUMBERS // (self._mass.shape[2] * sets * sets))
        parts = (slice(first, first + cells) for first in range(0, m, cells))
        each = [self._bound(part, worth, ends, separable=separable) for part in parts]
        return np.concatenate(each)

    def _bound(self, part: slice, worth: Array, ends: Array, *, separable: bool) -> Array:
        """The table of the cells `part`."""
        to, mass = self.to[part], self._mass[part]
        count, z = len(to), to.shape[1]
        # the moves two steps on, a pair (a, b) of successor and its successor in one index a Z + b
        after = self.to[to].reshape(count, -1)
        real = (self._there[part, :, None] & self._there[to]).reshape(count, -1)
        same = (
            (after[:, :, None] == after[:, None, :]) & real[:, :, None] & real[:, None, :]
        ).astype(float)
        flow = (mass[..., None] * self._p[to][:, None]).reshape(*mass.shape[:2], -1)
        takes_part = (flow > 0).astype(float)
        total, sharing = flow @ same, np.maximum(takes_part @ same, 1.0)
        price = self._cost[after][:, None] * (mass @ self._inside[to][..., None])
        # Revealed after this set, each sensor is decided by itself; of the pairs that lead to it each counts a part.
        reports = self._reports[to].reshape(count, -1)[:, None]
        missed = ends[after][:, None]
        seen = missed + reports * (self._detected[after][:, None] - missed)
        best = (np.maximum(total * seen - price, total * missed) * takes_part / sharing).sum(axis=2)
        if separable:
            return best
        gross = mass[..., None] * worth[to][:, None]
        share = np.divide(flow, total, out=np.zeros_like(flow), where=total > 0) * price
        for step in range(STEPS):
            each = gross - share.reshape(*mass.shape, z) @ self._sensed.T
            chosen = each.argmax(axis=3)
            best = np.minimum(
                best, np.take_along_axis(each, chosen[..., None], axis=3)[..., 0].sum(axis=2)
            )
            on = self._sensed[chosen].reshape(flow.shape) * takes_part
            share += price * (0.5 / (1.0 + 0.3 * step)) * (on - (on @ same) / sharing) * takes_part
        return best
