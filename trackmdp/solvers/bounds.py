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
    p = p * world.detects(world.kernel.indices)
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
    report = p * world.detects(world.kernel.indices)
    free = per_row(rows, np.maximum(report * world.reward - cost, 0.0), world.num_cells)
    # D is free to be anything: a safe action cheaper than the sensors it stands for is worth more than any free choice,
    # and would lie above the bound if it were left out.
    return np.maximum(free, world.safe_gain)


@lru_cache(maxsize=1)
def clocked_table(world: World) -> ClockedBound:
    """U(x, n) by policy iteration, each policy valued by one sparse solve.

    U(x, t_max + 1) = sum_j P_xj (r - D + U(j, 0)), and
    U(x, n) = sum_j max{P_xj [p_d (r + U(j, 0)) + (1 - p_d) U(j, n + 1)] - c_j P_in(x), P_xj U(j, n + 1)}.
    Where the safe action may miss, U(x, t_max + 1) = sum_j P_xj [p_s (r + U(j, 0)) + (1 - p_s) U(j, t_max + 1) - D].
    A bound for any p_d; not tight below 1, since a miss then never tells where the target is.

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
        candidate, exact = _value(world, improved, table)
        if candidate.sum() <= table.sum():  # only rounding is left to gain
            break
        sensed, table = improved, candidate
    # Iterated solves leave Û off by a little; with rho the excess of one improvement step over Û, and at most `longest`
    # steps to collect it on, U <= Û + longest * rho (theory-extensions, section 0).
    error = 0.0 if exact else float(expected_steps(world).max()) * _excess(world, table)
    return ClockedBound(table, error)


def _gains(world: World, table: Array) -> tuple[Array, Array]:
    """`[t_max + 1, E]` what sensing a possible move earns, and what leaving it unsensed does."""
    rows, cells, p = row_index(world.kernel), world.kernel.indices, world.kernel.data
    detected, missed = world.reward + table[cells, 0], table[cells, 1:].T
    worth = detected - (1.0 - world.detects(cells)) * (detected - missed)
    return p * worth - world.cost[cells] * world.stay_probability[rows], p * missed


def _improve(world: World, table: Array, sensed: BoolArray) -> BoolArray:
    """`[t_max + 1, E]` the choice for each possible move; a tie leaves the present choice."""
    rows, cells, p = row_index(world.kernel), world.kernel.indices, world.kernel.data
    # Both sides of the comparison are multiplied by the probability p of the move; what a sensor that is on misses is
    # worth p (1 - p_d) U(j, n + 1) on both, so that it is on iff p p_d (r + U(j, 0) - U(j, n + 1)) > c p_in.
    cost = world.cost[cells] * world.stay_probability[rows]
    gain = p * world.detects(cells) * (world.reward + table[cells, 0] - table[cells, 1:].T) - cost
    # without a margin, rounding could switch a tied choice to and fro for ever
    tie = 1e-12 * (1.0 + np.abs(table).max())
    return np.where(np.abs(gain) <= tie, sensed, gain > 0)


def _excess(world: World, table: Array) -> float:
    """The most by which the best choices, one step ahead, exceed `table`."""
    rows, (sense, leave) = row_index(world.kernel), _gains(world, table)
    best = [per_row(rows, np.maximum(on, off), world.num_cells) for on, off in zip(sense, leave, strict=True)]
    # The last column has no choice: the safe action is forced.
    best.append(world.kernel @ _after_safe_action(world, table))
    return max(float((np.stack(best, axis=1) - table).max()), 0.0)


def _after_safe_action(world: World, table: Array) -> Array:
    """`[M]` worth of the target being in each cell when the safe action has been carried out, its price included."""
    located = world.reward - world.safe_cost + table[:, 0]
    return located - world.safe_misses * (world.reward + table[:, 0] - table[:, -1])


def _value(world: World, sensed: BoolArray, guess: Array | None = None) -> tuple[Array, bool]:
    """`[M, t_max + 2]` U of the given choices, and whether it is exact; `guess` is a table near to it.

    U(., n) = earned[n] + reach[n] U(., 0), from the last n backwards: after the safe action reach is P; before it, a
    sensor that is on reaches a located cell with p_d, and what it misses, like what is unsensed, goes on with
    reach[n + 1]. Where the safe action may miss, U(., t_max + 1) is unknown as well, and reach has 2M columns.
    """
    moves, rows, cells = world.kernel, row_index(world.kernel), world.kernel.indices
    # With t_max = 1: reach[2] = P, reach[1] = hit_1 + miss_1 P, reach[0] = hit_0 + miss_0 reach[1]. Only the last is
    # solved with; the others give U(., n) by one product each.
    earned, reach = [world.safe_gain], [moves]
    if not world.safe:
        lost = sparse.csr_array(moves.multiply(world.safe_misses))
        reach = [sparse.csr_array(sparse.hstack([moves - lost, lost]))]
    # What a sensed move earns at once; the value of being located is in `reach`.
    reports = world.detects(cells)
    gain = moves.data * reports * world.reward - world.cost[cells] * world.stay_probability[rows]
    for choice in sensed[::-1]:
        hit, miss = _masked(moves, choice * reports), _masked(moves, 1.0 - choice * reports)
        hit.resize(reach[0].shape)
        earned.insert(0, per_row(rows, gain * choice, world.num_cells) + miss @ earned[0])
        reach.insert(0, hit + miss @ reach[0])
    unknown = slice(1) if world.safe else slice(None, None, world.num_choices)  # U(., 0), and U(., t_max + 1)
    system = RenewalSystem(sparse.csr_array(sparse.vstack(reach[unknown])), world.size)
    start = None if guess is None else guess.T[unknown].ravel()
    located = system.solve(np.concatenate(earned[unknown]), start)
    return np.stack([b + k @ located for b, k in zip(earned, reach, strict=True)], axis=1), system.exact


def _masked(moves: sparse.csr_array, keep: Array) -> sparse.csr_array:
    kept = sparse.csr_array((moves.data * keep, moves.indices, moves.indptr), shape=moves.shape, copy=True)
    kept.eliminate_zeros()
    return kept


def _truncated_valid(world: World, max_steps: int) -> Array:
    """`[M]` the valid bound on episodes of at most `max_steps` steps."""
    best, value = _best_step(world), np.zeros(world.num_cells)
    for _ in range(max_steps):
        before, value = value, best + world.kernel @ value
        if np.array_equal(before, value):  # the target is gone to the last bit: nothing changes from here on
            break
    return value


def _truncated_clocked(world: World, max_steps: int) -> Array:
    """`[M]` the clocked bound on episodes of at most `max_steps` steps.

    The optimum over policies that may also depend on the steps left, so a bound for those that may not.
    """
    moves, m = world.kernel, world.num_cells
    rows, cells, p = row_index(moves), moves.indices, moves.data
    # U_h(x, n) with h steps left, from U_0 = 0: each round adds one step in front.
    table = np.zeros((m, world.num_choices + 1))
    for _ in range(max_steps):
        best = [per_row(rows, np.maximum(on, off), m) for on, off in zip(*_gains(world, table), strict=True)]
        # n = t_max + 1: r - D, and located again, whose clock is 0; or missed, and the safe action again.
        forced = per_row(rows, p * _after_safe_action(world, table)[cells], m)
        before, table = table, np.stack([*best, forced], axis=1)
        if np.array_equal(before, table):
            break
    return table[:, 0]
