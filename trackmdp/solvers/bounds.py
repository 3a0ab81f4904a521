"""Upper bounds on the value of any policy (theory.md#bounds).

All of them grant the tracker knowledge that it does not have: the hidden state of the target before or after each step.
They hold for every memory. With one mode the state is the cell.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy import sparse

from trackmdp.arrays.entries import per_row, row_index, with_data
from trackmdp.arrays.types import AnyArray, Array
from trackmdp.sensing.choose import TIE
from trackmdp.sensing.decisions import Decisions, sensing
from trackmdp.solvers.linear import RenewalSystem, accumulate
from trackmdp.solvers.motion_totals import expected_steps, grid_of, still_to_come
from trackmdp.world.model import World


@dataclass(frozen=True)
class ClockedBound:
    """The clocked bound: the state is revealed after every action, but the clock n runs on.

    Attributes:
        table: `[Z, t_max + 2]`, U(z, n): the most that can follow n misses with the target known to be in state z.
        error: no entry of the exact table is larger by more; 0 where its systems were factorised.
    """

    table: Array
    error: float

    @property
    def value(self) -> Array:
        """`[Z]`, no less than U(z, 0) >= V*(z)."""
        return self.table[:, 0] + self.error


def paper(world: World) -> Array:
    """`[M]` V*_QMDP of eq. upper_bound_v as printed: sensors are paid for on the exit step as well.

    The reward is not, so this can lie below the value of a policy; see `valid`. It knows no `max_steps`.
    """
    # max{P_xj r - c_j, 0} for each possible move: here c_j is not multiplied by the probability of staying in the grid,
    # which is the difference to `_best_step`.
    gain = _free(world, _earned(world), np.ones(world.num_states))
    return of_cells(world, accumulate(world.kernel, gain, grid_of(world)))


def valid(world: World) -> Array:
    """`[M]` the state is revealed before every action, costs are charged like the reward: a true bound.

    Each step is worth the best free choice or, where D is less than that choice, the safe action; a window, which
    only takes choices away, is left out of account here and in `clocked`.
    """
    best = _best_step(world)
    if world.max_steps is None:
        return of_cells(world, accumulate(world.kernel, best, grid_of(world)))
    return of_cells(
        world, _cut(world, np.zeros(len(best)), lambda later: best + world.kernel @ later)
    )


def clocked(world: World) -> Array:
    """`[M]` the clocked bound U(x, 0): V* <= U <= `valid`.

    Where sensors that miss share cells both bounds are relaxed, and U may be the looser one.

    On episodes that are cut, the optimum over policies that may also depend on the steps left, so a bound for all other
    policies as well.
    """
    if world.max_steps is None:
        return of_cells(world, clocked_table(world).value)
    nothing = np.zeros((world.num_states, world.num_choices + 1))
    return of_cells(world, _cut(world, nothing, lambda later: _one_step(world, later))[:, 0])


def _cut(world: World, value: Array, step: Callable[[Array], Array]) -> Array:
    """`value` after `max_steps` times `step`, which adds one more step in front; or no less than that."""
    most = world.max_steps or 0
    for h in range(1, most + 1):
        before, value = value, step(value)
        change, largest = (float(np.abs(each).max()) for each in (value - before, value))
        more = still_to_come(world, change, largest, most - h)
        if more is not None:
            return value + more
    return value


def of_cells(world: World, value: Array) -> Array:
    """`[M]` means of `value` `[Z]` over the modes of each cell, all as likely at an episode's start."""
    return value if world.modes == 1 else value.reshape(world.num_cells, world.modes).mean(axis=1)


def _earned(world: World) -> Array:
    """`[E]` reward of a report after each possible move."""
    return world.kernel.data * world.reward


def safe_gain(world: World) -> Array:
    """`[Z]` expected reward of one safe action before which the target is in each state."""
    missed = 1.0 - world.safe_detection[world.motion.cell]
    gain: Array = (world.reward - world.safe_cost) * world.stay_probability
    return gain - world.reward * (world.kernel @ missed)


def _best_step(world: World) -> Array:
    """`[Z]` the most that one step is worth from a known state: the best free choice or the safe action."""
    # The reward is 0 on the exit step, costs included (eq. reward_func), so a sensor costs c_j P_in(x).
    free = _free(world, _earned(world), world.stay_probability)
    # D is free to be anything: a safe action cheaper than the sensors it stands for is worth more than any free choice,
    # and would lie above the bound if it were left out.
    return np.maximum(free, safe_gain(world))


@lru_cache(maxsize=1)
def _moves(world: World) -> Decisions:
    """The sensors that may report the target after one move from a known state; one entry for each of the kernel."""
    # int32: kept as long as the world is used.
    rows, to = row_index(world.kernel).astype(np.int32), world.kernel.indices
    cells = to if world.modes == 1 else world.motion.cell[to]
    return sensing(world, rows, cells, world.num_states, distinct=world.modes == 1)


def _free(world: World, gain: Array, charge: Array, *, exact: bool = False) -> Array:
    """`[Z]` the most that one free choice gains, of `gain` `[E]` for each move and prices times `charge` `[Z]`."""
    return _moves(world).cover(gain, _priced(world, charge), exact=exact).upper


def _priced(world: World, charge: Array) -> Array:
    """`[G]` expected prices of the sensors that may report, each paid with the probability `charge` `[Z]`."""
    moves = _moves(world)
    return world.prices[moves.sensors] * charge[moves.rows]


def one_set(world: World, detected: Array, missed: Array) -> Array:
    """`[Z]` the most that one set is worth from a known state: r + V (`detected`, `[Z]`), or else `missed` `[Z]`."""
    gain = world.kernel.data * (detected - missed)[world.kernel.indices]
    return world.kernel @ missed + _free(world, gain, world.stay_probability)


@lru_cache(maxsize=1)
def clocked_table(world: World) -> ClockedBound:
    """U(z, n) by policy iteration, each policy valued by one sparse solve.

    U(z, t_max + 1) = sum_z' P_zz' (r - D + U(z', 0)), and with A a set of sensors and b(z') the probability of a report

    U(z, n) = max_A sum_z' P_zz' [b (r + U(z', 0)) + (1 - b) U(z', n + 1)] - c(A) P_in(z).

    Where the safe action may miss, U(z, t_max + 1) = sum_z' P_zz' [p_s (r + U(z', 0)) + (1 - p_s) U(z', t_max + 1) -
    D]. A bound for any p_d; not tight below 1, since a miss then never reveals where the target is.

    Where sensors share cells, the choice at (z, n) is a coverage problem. Its linear relaxation stands for it, which
    bounds it from above (`cover`); see `exact_clocked_table`.

    The greedy policy of a table Û within rho of its own equation gives U <= Û + rho · (longest expected episode): under
    every policy the clocked process ends at each step with the target's probability of exit.
    """
    return _clocked(world, exact=False)


@lru_cache(maxsize=1)
def exact_clocked_table(world: World) -> ClockedBound:
    """U(z, n) with the coverage problems of footprints solved over sets, not relaxed; otherwise `clocked_table`.

    That as well where many sensors that miss share cells: their sets are good ones, of a smaller table, but what each
    may lack adds up over an episode.
    """
    if world.coverage is None:
        return clocked_table(world)
    return min(_clocked(world, exact=True), clocked_table(world), key=lambda each: each.value.sum())


@dataclass(frozen=True)
class _Choices:
    """The sets from each state after n = 0 ... t_max misses.

    Attributes:
        on: `[G, t_max + 1]`; shares, where sensors share cells.
        report: `[E, t_max + 1]`, probability of a report after each possible move.
        paid: `[Z, t_max + 1]`, expected prices.
    """

    on: AnyArray
    report: AnyArray
    paid: Array


def _clocked(world: World, *, exact: bool) -> ClockedBound:
    """U(z, n) by policy iteration."""
    # Any policy has a finite value; from there each round is worth more, and there are finitely many policies. The
    # first one, for which a miss costs D at once, senses nearly all: fewer rounds than from one that senses little.
    table = np.full((world.num_states, world.num_choices + 1), -world.safe_cost)
    table[:, 0] = 0.0
    choices = _best(world, table, exact=exact)
    table, solved = _value(world, choices)
    while True:
        improved = _best(world, table, exact=exact)
        # Other sensors may see the same cells.
        if (improved.report == choices.report).all() and (improved.paid == choices.paid).all():
            break
        candidate, solved = _value(world, improved, table)
        # Only rounding is left to gain; of the last column, where D may be any number, it would be the most.
        if candidate[:, :-1].sum() <= table[:, :-1].sum():
            break
        choices, table = improved, candidate
    # Iterated solves leave Û off by a little, as do linear programs and ties; with rho the excess of one improvement
    # step over Û, and L the expected steps from each cell, U <= Û + rho max L (theory.md#bounds).
    if solved and world.coverage is None:
        excess = _left_by_ties(world, table, choices)
    else:
        excess = float((_one_step(world, table, exact=exact) - table).max())
    error = float(expected_steps(world).max()) * excess if excess > 0.0 else 0.0
    return ClockedBound(table, error)


def _left_by_ties(world: World, table: Array, choices: _Choices) -> float:
    """The most that a best set gains over the one of `choices`; `table` is their value.

    Not as `_one_step` less `table`: of a large D in the last column that would be the rounding.
    """
    moves, price = _moves(world), _priced(world, world.stay_probability)
    left = []
    for n in range(world.num_choices):
        worth = _reports_worth(world, table, n)
        net = (moves.gained(worth[:, None])[:, 0] - price) * choices.on[:, n]
        most = moves.cover(worth, price).upper
        left.append(float((most - per_row(moves.rows, net, world.num_states)).max()))
    return max(left)


def _reports_worth(world: World, table: Array, n: int) -> Array:
    """`[E]` worth of a report over a miss after each possible move, n misses before it."""
    over_miss = world.reward + table[:, 0] - table[:, n + 1]
    return world.kernel.data * over_miss[world.kernel.indices]


def _best(world: World, table: Array, *, exact: bool) -> _Choices:
    """The best choices, one step ahead of `table`."""
    moves, price = _moves(world), _priced(world, world.stay_probability)
    asked = price * (1.0 - TIE)  # rounding decides no tie
    found = [
        moves.cover(_reports_worth(world, table, n), asked, exact=exact)
        for n in range(world.num_choices)
    ]
    paid = [per_row(moves.rows, each.on * price, world.num_states) for each in found]
    columns = [each.on for each in found], [each.seen for each in found], paid
    return _Choices(*(np.stack(each, axis=1) for each in columns))


def _one_step(world: World, table: Array, *, exact: bool = False) -> Array:
    """`[Z, t_max + 2]`, the best choice or, last, the safe action, then `table`; with footprints no less than that."""
    # n = t_max + 1: r - D, and located again, whose clock is 0; or missed, and the safe action again.
    missed = 1.0 - world.safe_detection[world.motion.cell]
    safe = world.reward - world.safe_cost + table[:, 0]
    safe = safe - missed * (world.reward + table[:, 0] - table[:, -1])
    best: Array = world.kernel @ np.column_stack([table[:, 1:], safe])
    for n in range(world.num_choices):
        worth = _reports_worth(world, table, n)
        best[:, n] += _free(world, worth, world.stay_probability, exact=exact)
    return best


def _value(world: World, choices: _Choices, guess: Array | None = None) -> tuple[Array, bool]:
    """`[Z, t_max + 2]` U of the given choices, and whether it is exact; `guess` is a table near to it.

    U(., n) = earned[n] + reach[n] U(., 0), from the last n backwards: after the safe action reach is P; before it, a
    report leads to a located state, and a miss goes on with reach[n + 1]. Where the safe action may miss,
    U(., t_max + 1) is unknown as well, and reach has 2Z columns.
    """
    moves, rows = world.kernel, row_index(world.kernel)
    # With t_max = 1: reach[2] = P, reach[1] = hit_1 + miss_1 P, reach[0] = hit_0 + miss_0 reach[1]. Only the last is
    # solved with; the others give U(., n) by one product each.
    earned, reach = [safe_gain(world)], [moves]
    if not world.safe:
        lost = sparse.csr_array(moves.multiply(1.0 - world.safe_detection[world.motion.cell]))
        reach = [sparse.hstack([moves - lost, lost])]
    gain = _earned(world)
    for n in reversed(range(world.num_choices)):
        report = choices.report[:, n]
        hit, miss = _masked(moves, report), _masked(moves, 1.0 - report)
        hit.resize(reach[0].shape)
        now = per_row(rows, gain * report, world.num_states) - choices.paid[:, n]
        earned.insert(0, now + miss @ earned[0])
        reach.insert(0, hit + miss @ reach[0])
    # U(., 0), and U(., t_max + 1)
    unknown = slice(1) if world.safe else slice(None, None, world.num_choices)
    size = grid_of(world)
    # Stacked only where there are two: a copy of the one would be a tenth of the memory at a million cells.
    whole = reach[0] if world.safe else sparse.vstack(reach[unknown])
    system = RenewalSystem(whole, size)
    start = None if guess is None else guess.T[unknown].ravel()
    located = system.solve(np.concatenate(earned[unknown]), start)
    table = [b + k @ located for b, k in zip(earned, reach, strict=True)]
    return np.stack(table, axis=1), system.exact


def _masked(moves: sparse.csr_array, keep: AnyArray) -> sparse.csr_array:
    kept = with_data(moves, moves.data * keep).copy()
    kept.eliminate_zeros()
    return kept
