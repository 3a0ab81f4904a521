"""Upper bounds on what any policy can earn: the paper's as printed, a valid one, and the clocked one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from trackmdp.solvers.renewal import accumulate, per_row, row_index
from trackmdp.world.model import Array, BoolArray, World

__all__ = ["Clocked", "clocked", "clocked_table", "paper", "valid"]


@dataclass(frozen=True)
class Clocked:
    """The clocked bound (theory: the position is revealed after every action, but the clock n runs on).

    Attributes:
        table: `[M, t_max + 2]`, U(x, n): the most that can follow n misses with the target known to be at x.
    """

    table: Array

    @property
    def value(self) -> Array:
        """`[M]`, U(x, 0) >= V*(x)."""
        return self.table[:, 0]


def paper(world: World) -> Array:
    """`[M]` V*_QMDP of eq. upper_bound_v as printed: sensors are paid for on the exit step as well.

    The reward is not, so this can lie below what a policy attains; see `valid`.
    """
    rows, p = row_index(world.kernel), world.kernel.data
    gain = np.maximum(p * world.reward - world.cost[world.kernel.indices], 0.0)
    return accumulate(world.kernel, per_row(rows, gain, world.num_cells))


def valid(world: World) -> Array:
    """`[M]` the position is revealed after every action, costs are charged like the reward: a true bound.

    Each step is worth the best free choice or, where D is less than that choice, the safe action.
    """
    rows, p = row_index(world.kernel), world.kernel.data
    cost = world.cost[world.kernel.indices] * world.stay_probability[rows]
    free = per_row(rows, np.maximum(p * world.reward - cost, 0.0), world.num_cells)
    forced = (world.reward - world.safe_cost) * world.stay_probability
    return accumulate(world.kernel, np.maximum(free, forced))


def clocked(world: World) -> Array:
    """`[M]` the clocked bound U(x, 0): V* <= U <= `valid`."""
    return clocked_table(world).value


def clocked_table(world: World) -> Clocked:
    """U(x, n) by policy iteration, each policy valued by one sparse solve.

    U(x, t_max + 1) = sum_j P_xj (r - D + U(j, 0)), and
    U(x, n) = sum_j max{P_xj (r + U(j, 0)) - c_j P_in(x), P_xj U(j, n + 1)}.
    """
    sensed = np.ones((world.num_choices, world.kernel.nnz), dtype=bool)
    table = _value(world, sensed)
    while True:
        improved = _improve(world, table, sensed)
        if (improved == sensed).all():
            return Clocked(table)
        candidate = _value(world, improved)
        if candidate.sum() <= table.sum():  # only rounding is left to gain
            return Clocked(table)
        sensed, table = improved, candidate


def _improve(world: World, table: Array, sensed: BoolArray) -> BoolArray:
    """`[t_max + 1, E]` the choice for each possible move; a tie leaves the present choice."""
    rows, cells, p = row_index(world.kernel), world.kernel.indices, world.kernel.data
    cost = world.cost[cells] * world.stay_probability[rows]
    gain = p * (world.reward + table[cells, 0] - table[cells, 1:].T) - cost
    tie = 1e-12 * (1.0 + np.abs(table).max())
    return np.where(np.abs(gain) <= tie, sensed, gain > 0)


def _value(world: World, sensed: BoolArray) -> Array:
    """`[M, t_max + 2]` U of the given choices: U(., n) = earned[n] + reach[n] U(., 0), from the last n backwards."""
    moves = world.kernel
    rows, cells = row_index(moves), moves.indices
    earned = [(world.reward - world.safe_cost) * world.stay_probability]
    reach = [moves]
    gain = moves.data * world.reward - world.cost[cells] * world.stay_probability[rows]
    for choice in sensed[::-1]:
        hit, miss = _masked(moves, choice), _masked(moves, ~choice)
        earned.insert(0, per_row(rows, gain * choice, world.num_cells) + miss @ earned[0])
        reach.insert(0, hit + miss @ reach[0])
    located = accumulate(reach[0], earned[0])
    return np.stack([b + k @ located for b, k in zip(earned, reach, strict=True)], axis=1)


def _masked(moves: sparse.csr_array, keep: BoolArray) -> sparse.csr_array:
    kept = sparse.csr_array((moves.data * keep, moves.indices, moves.indptr), shape=moves.shape, copy=True)
    kept.eliminate_zeros()
    return kept
