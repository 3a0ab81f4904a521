"""The paper's theorems and two of its remarks as checks, each with its largest deviation."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from trackmdp.arrays.types import Array, BoolArray
from trackmdp.paper import histories, proofs
from trackmdp.paper.check import NO_CASE, Check
from trackmdp.paper.corner import corner, dearer
from trackmdp.paper.histories import HistoryQ
from trackmdp.paper.worlds import paper_kernel, paper_world
from trackmdp.policies.table import PolicyTable
from trackmdp.sensing.task import window_cells
from trackmdp.solvers import bounds, estimator, pomdp, rules
from trackmdp.solvers import optimal as optimum
from trackmdp.solvers.hidden import averaged
from trackmdp.solvers.partition import reach
from trackmdp.solvers.solution import Solution
from trackmdp.solvers.value import value_of
from trackmdp.world.model import World

SLACK = 1e-10
"""Relative rounding that equalities are allowed, and the gap at which a search for the optimum ends."""
MOST_CELLS = 1_000
"""Cells up to which info states are listed in the world itself, in arrays `[M, M]`; above, in its corner."""
_OF_CELLS = {
    "Theorem 1": "p_j > c/r is sensed, p_j the probability of cell j given the last located cell",
    "Lemma 1": "known at b but undetected is worth at most located at b",
    "Theorem 2": "V*_TMDP = V*_POMDP, the state being the last located cell, the clock and the sets since",
    "Theorem 3": "the estimate from Q is the belief",
    "Q_MDP": "the threshold on p_j is Q_MDP's action, and V*_QMDP as printed solves its equation",
}
"""Statements on the last located cell as the state, which it is not for a target with a mode."""


def check_theorems(world: World, solution: Solution, tolerance: float) -> Iterator[Check]:
    """Every statement in the paper's order, then the checks of `proofs`.

    Args:
        world: the problem; Lemma 1, Theorem 2 and the exact form of Theorem 3 list all states of its corner.
        solution: its optimum; where it is not certified, deviations include the open gap.
        tolerance: deviation, relative to the largest value, that counts as equal.
    """
    scale = tolerance * _largest(world, solution)
    near = (world, solution)
    if world.num_cells > MOST_CELLS:
        near = (corner(world), optimum.solve(corner(world), tolerance=SLACK))
    for row in (
        *_track_property(*near),
        *_tower_lemma(world),
        *_as_pomdp(world),
        *_estimator(*near),
        *_qmdp_derivation(near[0]),
        *proofs.of_values(corner(world)),
        *proofs.of_bounds(corner(world)),
        *proofs.of_searches(),
        *_order(world, solution),
    ):
        yield row.judged(scale)


def check_modes(world: World, solution: Solution, tolerance: float) -> Iterator[Check]:
    """The statements without a case here, the checks of `proofs` on its corner, and the order of values.

    Args:
        world: the problem.
        solution: the best policy that was found, as good as its memory.
        tolerance: deviation, relative to the largest value, that counts as equal.
    """
    for name, statement in _OF_CELLS.items():
        note = "the next move depends on a mode as well: the last cell is no state"
        yield Check(name, statement, NO_CASE, holds=True, note=note)
    scale = tolerance * _largest(world, solution)
    for row in (*proofs.of_values(corner(world)), *proofs.of_bounds(corner(world))):
        yield row.judged(scale)
    plain, bound = value_of(world, rules.qmdp(averaged(world))), bounds.clocked(world)
    note = f"found {solution.lower:.6f}, bound {bound.mean():.6f}"
    above = float((solution.value - bound).max())
    statement = "the policy found <= clocked bound, which knows the mode"
    yield Check("order", statement, above, note=note).judged(scale)
    # Shown, not claimed: the policy found need not be the best that its memory allows.
    above, note = plain.aihtr - solution.lower, f"Q_MDP {plain.aihtr:.6f}"
    statement = "Q_MDP for the moves of cells, modes averaged <= the policy found"
    yield Check("order", statement, above, expected=False, note=note).judged(scale)


def _largest(world: World, solution: Solution) -> float:
    """The size of values that deviations are relative to."""
    # Values grow with the length of an episode (200 steps at p_exit = .005), and rounding with them; a hundredth of D
    # counts as well, since its digits are lost in differences.
    return max(1.0, float(np.abs(solution.bound).max()), 0.01 * world.safe_cost)


def check_remarks(tolerance: float) -> Iterator[Check]:
    """Both remarks, each with its figures."""
    for row in (_support(), _printed_bound()):
        yield row.judged(tolerance)


def info_states(world: World, policy: PolicyTable) -> Iterator[tuple[Array, BoolArray, BoolArray]]:
    """For n = 0 ... t_max: `[I, M]` each, of the I info states after n misses that can happen, one a located cell.

    The probability of the target in each cell after its next move, given the misses, the sensors that are on, and those
    that can be chosen.
    """
    kernel, sets, mass = world.kernel.toarray(), policy.dense() > 0, np.eye(world.num_cells)
    near = np.ones_like(mass, dtype=bool)
    if world.window is not None:
        near = window_cells(world.size, world.window).toarray()
    for n in range(world.num_choices):
        missed = mass.sum(axis=1)
        can = missed > 0
        moved = mass @ kernel
        yield moved[can] / missed[can, None], sets[can, n], near[can]
        mass = moved * (1.0 - sets[:, n] * world.detection)


def _gains(world: World, next_cell: Array) -> tuple[Array, Array]:
    """`[I, M]` each: gain of a sensor, its price paid on every step, as printed, and paid in the grid alone."""
    earned = next_cell * world.detection * world.reward
    return earned - world.cost, earned - world.cost * next_cell.sum(axis=1, keepdims=True)


def _track_property(world: World, solution: Solution) -> Iterator[Check]:
    # Theorem tracking_property: Pr(X_{k+1} = b | s_k) > c/r is sensed.
    largest, states = np.full(2, NO_CASE), 0
    for next_cell, on, _ in info_states(world, solution.table):
        unsensed = (next_cell > 0) & ~on
        gains = [gain[unsensed].max(initial=NO_CASE) for gain in _gains(world, next_cell)]
        largest, states = np.maximum(largest, gains), states + len(on)
    # Counted without the info states: the moves out of each cell that the first set leaves out.
    due = int(((world.kernel.toarray() > 0) & ~(solution.table.dense()[:, 0] > 0)).sum())
    statements = (
        ("Theorem 1", "p_j > c/r is sensed: largest p_j r - c left unsensed"),
        ("Theorem 1, sharp", "p_j > c p_in / r is sensed: largest p_j r - c p_in left unsensed"),
    )
    needs = _needs(world)
    for (name, statement), deviation in zip(statements, largest.tolist(), strict=True):
        note, closed = needs or f"{states} info states", solution.certified
        row = Check(name, statement, deviation, expected=not needs, note=note, closed=closed)
        yield row.of_cases(due)


def _needs(world: World) -> str:
    """The conditions of the proofs of Theorem 1 and Lemma 1 that the world breaks."""
    # The proofs let a policy imitate the forced action by all sensors; with D below their price that is a loss.
    dear = world.safe_cost >= float(world.cost.sum()) * (1.0 - SLACK)
    # A safe action that sees better than they do is worth seeking: to be missed may then pay.
    no_better = bool((world.safe_detection <= world.detection).all())
    needs = ["D >= the price of all sensors"] * (not dear) + ["p_s <= p_d"] * (not no_better)
    # Located elsewhere, it has to reach the same sensors.
    wide = world.window is None or world.window >= reach(world) * world.num_choices
    needs += ["a window of R (T_max + 1)"] * (not wide)
    return f"the proof needs {' and '.join(needs)}" if needs else ""


def _tower_lemma(world: World) -> Iterator[Check]:
    """Lemma 1 for every history of the corner, at its own prices and where misses pay."""
    statements = {
        "Lemma 1, first": "known at b but undetected is worth at most located at b: largest excess",
        "Lemma 1, second": "with b sensed too, the rest is worth at least as much: largest loss",
    }
    small, stated = corner(world), world.perfect and world.safe
    worlds = (small, dearer(small)) if stated else ()
    solved = [_histories(here) for here in worlds]
    losses = [loss for each in solved for loss in histories.miss_losses(each)]
    # Of a rest of cells there is only one where a miss leaves two or more.
    left = [np.count_nonzero(now) for each in solved for (_, past), now in each.now.items() if past]
    due = (stated * small.kernel.nnz, bool(max(left, default=0) > 1))
    worst = np.max([(NO_CASE, NO_CASE), *losses], axis=0)
    needs = _needs(small) if stated else ""
    note = needs or f"{len(losses)} misses, own prices and dearer ones, on the corner"
    note = note if stated else "stated for sensors that never miss"
    for (name, statement), deviation, cases in zip(
        statements.items(), worst.tolist(), due, strict=True
    ):
        yield Check(name, statement, deviation, expected=not needs, note=note).of_cases(cases)


def _histories(small: World) -> HistoryQ:
    return histories.solve_histories(small.but(t_max=min(small.t_max, 1)))


def _as_pomdp(world: World) -> Iterator[Check]:
    """Theorem 2 on the corner, at its own prices, and at prices at which the safe action is used."""
    # At low prices little is missed, and a wrong treatment of misses would hardly show.
    small = corner(world)
    for here, prices in ((small, "its own prices"), (dearer(small), "prices at which misses pay")):
        beliefs = pomdp.solve(here)
        best = optimum.solve(here, tolerance=SLACK)
        # Theorem thm:optimalaspomdp: V_TMDP((b, 0, {})) = V_POMDP((e_b, 0)) for every cell b.
        deviation = float(np.abs(beliefs.value - best.value).max())
        statement = "V*_TMDP = V*_POMDP, by plans of sets and over belief states"
        note = f"on the corner, {prices}, t_max {here.t_max}, {beliefs.beliefs} belief states"
        yield Check("Theorem 2", statement, deviation, note=note)


def _estimator(world: World, solution: Solution) -> Iterator[Check]:
    if not (world.perfect and world.safe):
        # With all others on, a miss does not mean that the target is where the one sensor is off.
        note = "stated for sensors that never miss"
        yield Check(
            "Theorem 3, exact form", "the estimate from Q is the belief", NO_CASE, note=note
        )
        return
    solved = _histories(dearer(corner(world)))
    yield from (_from_histories(solved), _from_the_solver(solved))
    found = estimator.positions(world, solution.table, solution.value)
    # Theorem thm:estimator sets the value after a miss equal to V(x, 0, {}), which forgets the clock n + 1, and adds c
    # where the exit step costs nothing (c p_in).
    paper = max(float(np.abs(e.paper - e.belief).max(initial=0.0)) for e in found)
    scored = estimator.accuracy(world, solution.table, solution.value)
    note = f"argmax right on {scored.paper:.2%} of missed steps, the belief's on {scored.bayes:.2%}"
    # With one candidate per info state the argmax is right for any numbers: 100 % then proves nothing.
    if all(np.bincount(e.rows[e.missed > 0]).max(initial=0) <= 1 for e in found):
        note = "a miss leaves one cell at most, so that every argmax is right"
    statement = "the printed form is the belief (it takes W = V and charges the exit step)"
    yield Check("Theorem 3, as printed", statement, paper, expected=False, note=note)


def _from_histories(solved: HistoryQ) -> Check:
    """The estimate from a Q over histories against the belief filter, where misses happen."""
    errors = [
        abs(estimate - histories.filtered(solved, state)[cell])
        for state in solved.q
        for cell, estimate in histories.estimates(solved, state).items()
    ]
    worst = float(max(errors, default=NO_CASE))
    note = f"on the corner, t_max {solved.world.t_max}, Q of {len(solved.q)} histories, without a belief"
    row = Check("Theorem 3, exact form", "the estimate from Q is the belief", worst, note=note)
    return row.of_cases(solved.world.kernel.nnz)


def _from_the_solver(solved: HistoryQ) -> Check:
    """The differences of Q in the program's estimator against those of a Q over histories."""
    world, errors = solved.world, []
    best = optimum.solve(world, tolerance=SLACK)
    sets = best.table.dense() > 0
    bits = [solved.bit(j) for j in range(world.num_cells)]
    for each in estimator.positions(world, best.table, best.value):
        for x, j, printed in zip(each.rows.tolist(), each.cells.tolist(), each.paper, strict=True):
            history = tuple(int(sets[x, n] @ bits) for n in range(each.n))
            if (x, history) in solved.q:
                exact = histories.advantage(solved, (x, history), j) + world.cost[j]
                errors.append(float(abs(printed - exact / world.reward)))
    statement = "the estimator's differences of Q are those of a Q over histories"
    note = f"on the corner, {len(errors)} differences"
    worst = max(errors, default=NO_CASE)
    return Check("Theorem 3, differences", statement, worst, note=note).of_cases(world.kernel.nnz)


def _qmdp_derivation(world: World) -> Iterator[Check]:
    # Lemma lem:qmdp_pol: Q_MDP's action separates into the sensors, each on iff p r >= c (or c p_in, as the reward
    # charges).
    for in_grid, threshold in ((False, "c/r"), (True, "c p_in / r")):
        worst = NO_CASE
        for next_cell, on, near in info_states(world, rules.qmdp(world, in_grid=in_grid)):
            gain = _gains(world, next_cell)[in_grid]
            # Switching a sensor on gains `gain`, switching it off -gain; none may be positive.
            switched = np.where(on, -gain, gain)[(next_cell > 0) & near]
            worst = max(worst, float(switched.max(initial=NO_CASE)))
        statement = f"threshold {threshold}: largest gain of switching one sensor over"
        yield Check("Q_MDP", statement, worst).of_cases(1)
    # eq. upper_bound_v at a known position, gamma = 1: V(x) = sum_j max(P_xj r - c_j, 0) + sum_j P_xj V(j).
    value, kernel = bounds.paper(world), world.kernel.toarray()
    gain = np.maximum(_gains(world, kernel)[0], 0.0).sum(axis=1)
    residual = float(np.abs(gain + kernel @ value - value).max())
    statement = "V*_QMDP as printed solves its equation: largest residual"
    yield Check("Q_MDP", statement, residual)


def _order(world: World, solution: Solution) -> Iterator[Check]:
    # Each relaxes the next: play without knowing, known with the clock, known without it. The inequality holds cell by
    # cell: the largest difference over start cells is checked; the notes give the means, which are AIHTRs.
    upper, valid, printed = bounds.clocked(world), bounds.valid(world), bounds.paper(world)
    others = value_of(world, rules.qmdp(world)).value
    gap = f"gap {solution.upper - solution.lower:.2g}"
    rows = (
        ("Q_MDP <= optimum", others, solution.bound, f"optimum {solution.lower:.6f}, {gap}"),
        ("optimum <= clocked bound", solution.value, upper, f"{upper.mean():.6f}"),
        ("clocked bound <= valid bound", upper, valid, f"{valid.mean():.6f}"),
    )
    closed = solution.certified
    for statement, low, high, note in rows:
        yield Check("order", statement, float((low - high).max()), note=note, closed=closed)
    statement = "optimum <= the printed bound (it charges sensors on the exit step)"
    excess = float((solution.value - printed).max())
    note = f"{printed.mean():.6f}"
    yield Check("order", statement, excess, expected=False, note=note, closed=closed)


def _support() -> Check:
    # The paper's remark: at c = 0.14 both probabilities of Z = 4, 0.15 and (1 - 0.15 - 0.005) / 3 = 0.28, exceed c/r.
    # Renormalizing at the border only raises them, so that the remark holds for every draw; this is one.
    world = paper_world(paper_kernel(4, seed=4, border="renormalize"), 0.14, 1)
    support = world.kernel.toarray() > 0
    best, simple = optimum.solve(world), rules.qmdp(world)
    # `[M, M]` sets of n = 0 alone: where the support is sensed no miss follows, and later sets are never used.
    wrong = sum(int((table.dense()[:, 0] != support).sum()) for table in (best.table, simple))
    # One wrong sensor already counts as 1, far above any tolerance.
    deviation = max(float(wrong), 1.0 - best.evaluation.accuracy)
    statement = "optimum and Q_MDP sense exactly the support, accuracy 100 %: sensors that differ"
    return Check("remark, c = 0.14, Z = 4", statement, deviation, note="N = 10, t_max 1")


def _printed_bound() -> Check:
    # One counter-example is enough: the printed bound charges c for every sensor on the exit step, the reward does not.
    world = paper_world(paper_kernel(5, seed=5, border="inside"), 0.16, 5)
    printed = bounds.paper(world).mean()
    achieved = value_of(world, rules.clocked_policy(world)).aihtr
    note = f"bound {printed:.2f}, a policy attains {achieved:.2f} (border inside, Z = 5, c = 0.16, t_max 5)"
    statement = "no policy exceeds the printed bound"
    excess = float(achieved - printed)
    return Check("the printed bound", statement, excess, expected=False, note=note)
