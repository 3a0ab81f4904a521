"""Upper bounds on what any policy can earn: the paper's as printed, a valid one, and the clocked one."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy import sparse

from trackmdp.solvers.renewal import RenewalSystem, accumulate, expected_steps, per_row, row_index
from trackmdp.world.model import Array, BoolArray, World

__all__ = ["ClockedBound", "clocked", "clocked_table", "paper", "valid"]


@dataclass(frozen=True)
class ClockedBound:
    """The clocked bound (theory: the position is revealed after every action, but the clock n runs on).

    Attributes:
        table: `[M, t_max + 2]`, U(x, n): the most that can follow n misses with the target known to be at x.
        error: no entry of the exact table is larger by more; 0 where its systems were factorised.
    """

    table: Array
    error: float

    @property
    def value(self) -> Array:
        """`[M]`, no less than U(x, 0) >= V*(x)."""
        return self.table[:, 0] + self.error


def paper(world: World) -> Array:
    """`[M]` V*_QMDP of eq. upper_bound_v as printed: sensors are paid for on the exit step as well.

    The reward is not, so this can lie below what a policy attains; see `valid`. It knows no `max_steps`.
    """
    rows, p = row_index(world.kernel), world.kernel.data
    # max{P_xj r - c_j, 0} for each possible move: here c_j is not multiplied by the probability of staying in the grid,
    # which is the difference to `_best_step`.
    gain = np.maximum(p * world.reward - world.cost[world.kernel.indices], 0.0)
    return accumulate(world.kernel, per_row(rows, gain, world.num_cells), world.size)


def valid(world: World) -> Array:
    """`[M]` the position is revealed after every action, costs are charged like the reward: a true bound.

    Each step is worth the best free choice or, where D is less than that choice, the safe action; a window, which
    only takes choices away, is left out of account here and in `clocked`.
    """
    if world.max_steps is not None:
        return _truncated_valid(world, world.max_steps)
    return accumulate(world.kernel, _best_step(world), world.size)


def clocked(world: World) -> Array:
    """`[M]` the clocked bound U(x, 0): V* <= U <= `valid`."""
    if world.max_steps is not None:
        return _truncated_clocked(world, world.max_steps)
    return clocked_table(world).value


def _best_step(world: World) -> Array:
    """`[M]` the most that one step is worth from a known position: the best free choice or the safe action."""
    rows, p = row_index(world.kernel), world.kernel.data
    # The reward is 0 on the exit step, costs included (eq. reward_func), so a sensor costs c_j P_in(x).
    cost = world.cost[world.kernel.indices] * world.stay_probability[rows]
    # Sensors add up: each is on where it gains, and a cell that cannot be reached never is.
    free = per_row(rows, np.maximum(p * world.reward - cost, 0.0), world.num_cells)
    # D is free to be anything: a safe action cheaper than the sensors it stands for is worth more than any free choice,
    # and would lie above the bound if it were left out.
    return np.maximum(free, (world.reward - world.safe_cost) * world.stay_probability)


@lru_cache(maxsize=1)
def clocked_table(world: World) -> ClockedBound:
    """U(x, n) by policy iteration, each policy valued by one sparse solve.

    U(x, t_max + 1) = sum_j P_xj (r - D + U(j, 0)), and
    U(x, n) = sum_j max{P_xj (r + U(j, 0)) - c_j P_in(x), P_xj U(j, n + 1)}.

    The greedy policy of a table Û within rho of its own equation gives U <= Û + rho · (longest expected episode): the
    clocked process is left at every step with the target's probability of exit, whatever is chosen.
    """
    # all on is a policy of finite value; from there each round is worth more, and there are finitely many policies
    # [t_max + 1, E], one choice per n and possible move: with the position known, sets need not be the same for all
    # paths.
    sensed = np.ones((world.num_choices, world.kernel.nnz), dtype=bool)
    table, exact = _value(world, sensed)
    while True:
        improved = _improve(world, table, sensed)
        if (improved == sensed).all():
            break
        candidate, exact = _value(world, improved)
        if candidate.sum() <= table.sum():  # only rounding is left to gain
            break
        sensed, table = improved, candidate
    # Iterated solves leave Û off by a little; with rho the excess of one improvement step over Û, and at most `longest`
    # steps to collect it on, U <= Û + longest * rho (theory-extensions, section 0).
    error = 0.0 if exact else float(expected_steps(world).max()) * _excess(world, table)
    return ClockedBound(table, error)


def _gains(world: World, table: Array) -> tuple[Array, Array]:
    """`[E]` what sensing a possible move earns, and `[t_max + 1, E]` what leaving it unsensed does."""
    rows, cells, p = row_index(world.kernel), world.kernel.indices, world.kernel.data
    sense = p * (world.reward + table[cells, 0]) - world.cost[cells] * world.stay_probability[rows]
    return sense, p * table[cells, 1:].T


def _improve(world: World, table: Array, sensed: BoolArray) -> BoolArray:
    """`[t_max + 1, E]` the choice for each possible move; a tie leaves the present choice."""
    rows, cells, p = row_index(world.kernel), world.kernel.indices, world.kernel.data
    # Both sides of the comparison are multiplied by the probability of the move: sense iff p (r + U(j,0)) - c > p
    # U(j,n+1).
    cost = world.cost[cells] * world.stay_probability[rows]
    gain = p * (world.reward + table[cells, 0] - table[cells, 1:].T) - cost
    # without a margin, rounding could switch a tied choice to and fro for ever
    tie = 1e-12 * (1.0 + np.abs(table).max())
    return np.where(np.abs(gain) <= tie, sensed, gain > 0)


def _excess(world: World, table: Array) -> float:
    """The most by which the best choices, one step ahead, exceed `table`."""
    rows, (sense, leave) = row_index(world.kernel), _gains(world, table)
    best = [per_row(rows, np.maximum(sense, left), world.num_cells) for left in leave]
    # The last column has no choice: the safe action is forced.
    best.append(world.kernel @ (world.reward - world.safe_cost + table[:, 0]))
    return max(float((np.stack(best, axis=1) - table).max()), 0.0)


def _value(world: World, sensed: BoolArray) -> tuple[Array, bool]:
    """`[M, t_max + 2]` U of the given choices, and whether it is exact.

    U(., n) = earned[n] + reach[n] U(., 0), from the last n backwards: after the safe action reach is P; before it, a
    move that is sensed reaches a located cell at once, one that is not goes on with reach[n + 1].
    """
    moves = world.kernel
    rows, cells = row_index(moves), moves.indices
    # With t_max = 1: reach[2] = P, reach[1] = hit_1 + miss_1 P, reach[0] = hit_0 + miss_0 reach[1]. Only the last is
    # solved with; the others give U(., n) by one product each.
    earned = [(world.reward - world.safe_cost) * world.stay_probability]
    reach = [moves]
    # What a sensed move earns at once; the value of being located is in `reach`.
    gain = moves.data * world.reward - world.cost[cells] * world.stay_probability[rows]
    for choice in sensed[::-1]:
        hit, miss = _masked(moves, choice), _masked(moves, ~choice)
        earned.insert(0, per_row(rows, gain * choice, world.num_cells) + miss @ earned[0])
        reach.insert(0, hit + miss @ reach[0])
    system = RenewalSystem(reach[0], world.size)
    located = system.solve(earned[0])
    return np.stack([b + k @ located for b, k in zip(earned, reach, strict=True)], axis=1), system.exact


def _masked(moves: sparse.csr_array, keep: BoolArray) -> sparse.csr_array:
    kept = sparse.csr_array((moves.data * keep, moves.indices, moves.indptr), shape=moves.shape, copy=True)
    kept.eliminate_zeros()
    return kept


def _truncated_valid(world: World, max_steps: int) -> Array:
    """`[M]` the valid bound on episodes of at most `max_steps` steps."""
    best, value = _best_step(world), np.zeros(world.num_cells)
    for _ in range(max_steps):
        value = best + world.kernel @ value
    return value


def _truncated_clocked(world: World, max_steps: int) -> Array:
    """`[M]` the clocked bound on episodes of at most `max_steps` steps.

    The optimum over policies that may also depend on the steps left, so a bound for those that may not.
    """
    moves, m = world.kernel, world.num_cells
    rows, cells, p = row_index(moves), moves.indices, moves.data
    cost = world.cost[cells] * world.stay_probability[rows]
    # U_h(x, n) with h steps left, from U_0 = 0: each round adds one step in front.
    table = np.zeros((m, world.num_choices + 1))
    for _ in range(max_steps):
        located = table[cells, 0]
        gains = [
            per_row(rows, np.maximum(p * (world.reward + located) - cost, p * table[cells, n + 1]), m)
            for n in range(world.num_choices)
        ]
        # n = t_max + 1: r - D, and located again, whose clock is 0.
        forced = per_row(rows, p * (world.reward - world.safe_cost + located), m)
        table = np.stack([*gains, forced], axis=1)
    return table[:, 0]
