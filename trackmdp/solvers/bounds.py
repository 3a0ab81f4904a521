"""Upper bounds on what any policy can earn: the paper's as printed, a valid one, and the clocked one."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy import sparse

from trackmdp.solvers.cover import Cover, Covering
from trackmdp.solvers.renewal import RenewalSystem, accumulate, expected_steps, per_row, row_index
from trackmdp.world.model import Array, BoolArray, World


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
    p = world.kernel.data
    # max{P_xj r - c_j, 0} for each possible move: here c_j is not multiplied by the probability of staying in the grid,
    # which is the difference to `_best_step`.
    gain = p * world.detects(world.kernel.indices) * world.reward
    return accumulate(world.kernel, _free(world, gain, np.ones(world.num_cells)), world.size)


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
    report = world.kernel.data * world.detects(world.kernel.indices)
    # The reward is 0 on the exit step, costs included (eq. reward_func), so a sensor costs c_j P_in(x).
    free = _free(world, report * world.reward, world.stay_probability)
    # D is free to be anything: a safe action cheaper than the sensors it stands for is worth more than any free choice,
    # and would lie above the bound if it were left out.
    return np.maximum(free, world.safe_gain)


def _free(world: World, gain: Array, charge: Array) -> Array:
    """`[M]` the most that one free choice gains, of `gain` `[E]` for each move and prices times `charge` `[M]`."""
    if (covering := _covering(world)) is not None:
        return covering.best(gain, covering.price(world.cost, charge)).upper
    # Sensors add up: each is on where it gains, and a cell that cannot be reached never is.
    rows, cells = row_index(world.kernel), world.kernel.indices
    return per_row(rows, np.maximum(gain - world.cost[cells] * charge[rows], 0.0), world.num_cells)


def one_set(world: World, detected: Array, missed: Array) -> Array:
    """`[M]` the most that one set is worth from a known position: r + V (`detected`, `[M]`), or else `missed` `[M]`."""
    gain = world.kernel.data * world.detects(world.kernel.indices) * (detected - missed)[world.kernel.indices]
    return world.kernel @ missed + _free(world, gain, world.stay_probability)


@lru_cache(maxsize=1)
def _covering(world: World) -> Covering | None:
    """Which sensors see the target after one move from a known position; None where each covers its own cell."""
    return Covering.of(world, row_index(world.kernel), world.kernel.indices)


@lru_cache(maxsize=1)
def clocked_table(world: World) -> ClockedBound:
    """U(x, n) by policy iteration, each policy valued by one sparse solve.

    U(x, t_max + 1) = sum_j P_xj (r - D + U(j, 0)), and
    U(x, n) = sum_j max{P_xj [p_d (r + U(j, 0)) + (1 - p_d) U(j, n + 1)] - c_j P_in(x), P_xj U(j, n + 1)}.
    Where the safe action may miss, U(x, t_max + 1) = sum_j P_xj [p_s (r + U(j, 0)) + (1 - p_s) U(j, t_max + 1) - D].
    A bound for any p_d; not tight below 1, since a miss then never tells where the target is.

    Where sensors have footprints, the choice at (x, n) is a coverage problem: U(x, n) = sum_j P_xj U(j, n + 1) plus the
    most that the union of a set's footprints gains, less the prices of the set. Its linear relaxation stands for it,
    which bounds it from above (`cover`); see `exact_clocked_table`.

    The greedy policy of a table Û within rho of its own equation gives U <= Û + rho · (longest expected episode): the
    clocked process is left at every step with the target's probability of exit, whatever is chosen.
    """
    return _clocked(world, exact=False)


@lru_cache(maxsize=1)
def exact_clocked_table(world: World) -> ClockedBound:
    """U(x, n) with the coverage problems of footprints solved over sets, not relaxed; otherwise `clocked_table`."""
    return _clocked(world, exact=True) if world.coverage is not None else clocked_table(world)


def _clocked(world: World, *, exact: bool) -> ClockedBound:
    """U(x, n) by policy iteration."""
    # all on is a policy of finite value; from there each round is worth more, and there are finitely many policies
    # [t_max + 1, E], one choice per n and possible move: with the position known, sets need not be the same for all
    # paths.
    choices = _all_on(world)
    table, solved = _value(world, choices)
    while True:
        improved = _improve(world, table, choices, exact=exact)
        if improved.same_as(choices):
            break
        candidate, solved = _value(world, improved, table)
        if candidate.sum() <= table.sum():  # only rounding is left to gain
            break
        choices, table = improved, candidate
    # Iterated solves leave Û off by a little, and so do linear programs; with rho the excess of one improvement step
    # over Û, and at most `longest` steps to collect it on, U <= Û + longest * rho (theory-extensions, section 0).
    sure = solved and world.coverage is None
    error = 0.0 if sure else float(expected_steps(world).max()) * _excess(world, table, exact=exact)
    return ClockedBound(table, error)


@dataclass(frozen=True)
class _Choices:
    """What is sensed from each position after n misses.

    Attributes:
        sensed: `[t_max + 1, E]`, whether each possible move is; with footprints a share, where fractions are allowed.
        paid: `[t_max + 1, M]`, with footprints the price of the sensors on; None where the moves sensed tell.
    """

    sensed: Array | BoolArray
    paid: Array | None = None

    def same_as(self, other: _Choices) -> bool:
        """Whether the same is sensed, at the same price: other sensors may see the same cells."""
        return bool((self.sensed == other.sensed).all()) and (
            self.paid is None or other.paid is None or bool((self.paid == other.paid).all())
        )


def _all_on(world: World) -> _Choices:
    sensed = np.ones((world.num_choices, world.kernel.nnz), dtype=bool)
    if world.coverage is None:
        return _Choices(sensed)
    price = world.cost.sum() * world.stay_probability
    return _Choices(sensed * (world.coverage.degree[world.kernel.indices] > 0), np.tile(price, (world.num_choices, 1)))


def _covered(world: World, table: Array, *, exact: bool) -> list[Cover]:
    """The coverage problems after 0 ... t_max misses, of what seeing the target gains over `table`."""
    cells, covering = world.kernel.indices, _covering(world)
    assert covering is not None
    price = covering.price(world.cost, world.stay_probability)
    gains = world.kernel.data * (world.reward + table[cells, 0] - table[cells, 1:].T)
    return [covering.best(gain, price, exact=exact) for gain in gains]


def _gains(world: World, table: Array) -> tuple[Array, Array]:
    """`[t_max + 1, E]` what sensing a possible move earns, and what leaving it unsensed does."""
    rows, cells, p = row_index(world.kernel), world.kernel.indices, world.kernel.data
    detected, missed = world.reward + table[cells, 0], table[cells, 1:].T
    worth = detected - (1.0 - world.detects(cells)) * (detected - missed)
    return p * worth - world.cost[cells] * world.stay_probability[rows], p * missed


def _improve(world: World, table: Array, choices: _Choices, *, exact: bool) -> _Choices:
    """The best choices, one step ahead; a tie leaves the present one."""
    if (covering := _covering(world)) is not None:
        found, price = _covered(world, table, exact=exact), covering.price(world.cost, world.stay_probability)
        paid = [per_row(covering.rows, each.on * price, world.num_cells) for each in found]
        return _Choices(np.stack([each.seen for each in found]), np.stack(paid))
    rows, cells, p = row_index(world.kernel), world.kernel.indices, world.kernel.data
    # Both sides of the comparison are multiplied by the probability p of the move; what a sensor that is on misses is
    # worth p (1 - p_d) U(j, n + 1) on both, so that it is on iff p p_d (r + U(j, 0) - U(j, n + 1)) > c p_in.
    cost = world.cost[cells] * world.stay_probability[rows]
    gain = p * world.detects(cells) * (world.reward + table[cells, 0] - table[cells, 1:].T) - cost
    # without a margin, rounding could switch a tied choice to and fro for ever
    tie = 1e-12 * (1.0 + np.abs(table).max())
    return _Choices(np.where(np.abs(gain) <= tie, choices.sensed, gain > 0))


def _best_choices(world: World, table: Array, *, exact: bool) -> list[Array]:
    """For n = 0 ... t_max `[M]`, what the best choice and then `table` are worth; with footprints no less than that."""
    rows = row_index(world.kernel)
    if world.coverage is not None:
        covers = _covered(world, table, exact=exact)
        return [world.kernel @ later + each.upper for later, each in zip(table[:, 1:].T, covers, strict=True)]
    return [per_row(rows, np.maximum(on, off), world.num_cells) for on, off in zip(*_gains(world, table), strict=True)]


def _excess(world: World, table: Array, *, exact: bool) -> float:
    """The most by which the best choices, one step ahead, exceed `table`."""
    best = _best_choices(world, table, exact=exact)
    # The last column has no choice: the safe action is forced.
    best.append(world.kernel @ _after_safe_action(world, table))
    return max(float((np.stack(best, axis=1) - table).max()), 0.0)


def _after_safe_action(world: World, table: Array) -> Array:
    """`[M]` worth of the target being in each cell when the safe action has been carried out, its price included."""
    located = world.reward - world.safe_cost + table[:, 0]
    return located - world.safe_misses * (world.reward + table[:, 0] - table[:, -1])


def _value(world: World, choices: _Choices, guess: Array | None = None) -> tuple[Array, bool]:
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
    gain = moves.data * reports * world.reward
    if choices.paid is None:
        gain = gain - world.cost[cells] * world.stay_probability[rows]
    for n in reversed(range(world.num_choices)):
        choice = choices.sensed[n]
        hit, miss = _masked(moves, choice * reports), _masked(moves, 1.0 - choice * reports)
        hit.resize(reach[0].shape)
        now = per_row(rows, gain * choice, world.num_cells)
        now = now if choices.paid is None else now - choices.paid[n]
        earned.insert(0, now + miss @ earned[0])
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
        best = _best_choices(world, table, exact=False)
        # n = t_max + 1: r - D, and located again, whose clock is 0; or missed, and the safe action again.
        forced = per_row(rows, p * _after_safe_action(world, table)[cells], m)
        before, table = table, np.stack([*best, forced], axis=1)
        if np.array_equal(before, table):
            break
    return table[:, 0]
