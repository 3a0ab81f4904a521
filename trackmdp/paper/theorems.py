"""The paper's theorems and two of its remarks as checks, each with its largest deviation."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import sparse

from trackmdp.errors import UserError
from trackmdp.paper import histories
from trackmdp.paper.worlds import paper_kernel, paper_world
from trackmdp.policies.table import PolicyTable
from trackmdp.solvers import bounds, estimator, pomdp, qmdp
from trackmdp.solvers import optimal as optimum
from trackmdp.solvers.branch import Tree
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.keyed import averaged
from trackmdp.solvers.keyed_search import cell_bound
from trackmdp.solvers.known import tables, up_to
from trackmdp.solvers.layers import Layer, layer_sets, reachable_layers
from trackmdp.solvers.prediction import followed
from trackmdp.solvers.renewal import per_row, row_index
from trackmdp.solvers.search import InnerProblem
from trackmdp.solvers.solution import Solution
from trackmdp.world.model import Array, BoolArray, World
from trackmdp.world.modes import HiddenWorld

# Relative rounding that equalities are allowed, and the gap at which a search for the optimum ends.
SLACK = 1e-10
# How far below the plan being followed the search of Lemma 1 begins.
SEARCHED = 1e-6
MOST_NODES = 500_000
CORNER = 2
"""Side of the corner that stands for a world too large for listing all of its states."""
_MOST_CELLS, _MOST_BELIEFS = 9, 20_000
"""Of a world that the POMDP is solved in as a whole."""
_OF_CELLS = {
    "Theorem 1": "p_j > c/r is sensed, p_j the probability of cell j given the last located cell",
    "Lemma 1": "known at b but undetected is worth at most located at b",
    "Theorem 2": "V*_TMDP = V*_POMDP, the state being the last located cell, the clock and the sets since",
    "Theorem 3": "the estimate from Q is the belief",
    "Q_MDP": "the threshold on p_j is Q_MDP's action, and V*_QMDP as printed solves its equation",
}
"""Statements whose state is the last located cell: of a target with a mode it says too little of the next move."""


@dataclass(frozen=True)
class Check:
    """One statement and how far the world is from it.

    Attributes:
        name: the statement's place in the paper.
        statement: what is checked.
        deviation: largest deviation; 0 or less where an inequality holds everywhere.
        holds: whether the deviation is within the tolerance; set by who knows that.
        expected: whether the statement is claimed here; the paper's looser forms are shown, not claimed.
        note: figures or conditions.
        closed: whether the solver came to its end; else a deviation may be the solver's, and is no counter-example.
    """

    name: str
    statement: str
    deviation: float
    holds: bool = False
    expected: bool = True
    note: str = ""
    closed: bool = True

    @property
    def verdict(self) -> str:
        """`holds`, `FAILS`, `no case` (nothing to check here) or `open` (solver cut short), or not claimed."""
        if self.deviation == -np.inf:
            return "no case"
        if not self.holds and not self.closed:
            return "open"
        if self.expected:
            return "holds" if self.holds else "FAILS"
        return "not claimed; holds here" if self.holds else "not claimed; does not hold"

    @property
    def passed(self) -> bool:
        """Whether nothing that is claimed is refuted."""
        return self.verdict != "FAILS"


def check_theorems(world: World, solution: Solution, tolerance: float) -> Iterator[Check]:
    """Every statement in the paper's order, for the optimal policy in `solution`.

    Args:
        world: the problem; Theorem 2 and the exact form of Theorem 3 list all states, of its corner where it is large.
        solution: the optimum; where it is not certified, deviations include what is open.
        tolerance: deviation, relative to the largest value, that counts as equal.
    """
    # Values grow with the length of an episode (200 steps at p_exit = 0.005), and rounding with them.
    scale = tolerance * max(1.0, float(np.abs(solution.bound).max()))
    # The proofs let a policy imitate the forced action by all sensors; with D below their price that is a loss.
    dear = world.safe_cost >= float(world.cost.sum()) * (1.0 - SLACK)
    # A safe action that sees better than they do is worth seeking: to be missed may then pay.
    no_better = bool((world.safe_detection <= world.detection).all())
    needs = ["D >= the price of all sensors"] * (not dear) + ["p_s <= p_d"] * (not no_better)
    # These rest on the optimal policy, so that an open gap of the solver leaves a violation open, not proved.
    for row in (*_track_property(world, solution), *_tower_lemma(world, solution)):
        note = row.note or (f"the proof needs {' and '.join(needs)}" if needs else "")
        closed = row.closed and solution.certified
        yield replace(row, holds=row.deviation <= scale, expected=not needs, note=note, closed=closed)
    # These need no optimum of the whole world: a violation is one.
    for row in (*_as_pomdp(world), *_estimator(world, solution), *_qmdp_derivation(world)):
        yield replace(row, holds=row.deviation <= scale)
    for row in _order(world, solution):
        yield replace(row, holds=row.deviation <= scale, closed=solution.certified)


def check_modes(world: HiddenWorld, solution: Solution, tolerance: float) -> Iterator[Check]:
    """The statements that have no case here, and the order of values, which holds all the same.

    Args:
        world: the problem.
        solution: the best policy that was found, as good as what it remembers.
        tolerance: deviation, relative to the largest value, that counts as equal.
    """
    for name, statement in _OF_CELLS.items():
        note = "the next move depends on a mode as well: the last cell is no state"
        yield Check(name, statement, -np.inf, holds=True, note=note)
    scale = tolerance * max(1.0, float(np.abs(solution.bound).max()))
    plain, bound = evaluate(world, qmdp.solve(averaged(world))), cell_bound(world)
    note = f"found {solution.lower:.6f}, bound {bound.mean():.6f}"
    above = float((solution.value - bound).max())
    statement = "what was found <= clocked bound, which knows the mode"
    yield Check("order", statement, above, holds=above <= scale, note=note)
    # Shown, not claimed: nothing says that what was found is the best that its memory allows.
    above = plain.aihtr - solution.lower
    statement = "Q_MDP for the moves of cells, modes averaged <= what was found"
    yield Check("order", statement, above, holds=above <= scale, expected=False, note=f"Q_MDP {plain.aihtr:.6f}")


def check_remarks(tolerance: float) -> Iterator[Check]:
    """Both remarks, each with its figures."""
    yield _support(tolerance)
    yield _printed_bound(tolerance)


def summarize_checks(found: Sequence[Check]) -> str:
    """The number of claims by verdict, in one line; forms that are not claimed are counted apart."""
    claims = [check.verdict for check in found if check.expected]
    counts = {verdict: claims.count(verdict) for verdict in ("holds", "no case", "open", "FAILS")}
    words = {"holds": "hold", "no case": "have no case in this world", "open": "are open", "FAILS": "FAIL"}
    said = [f"{count} {words[verdict]}" for verdict, count in counts.items() if count or verdict in ("holds", "FAILS")]
    loose = [check for check in found if not check.expected]
    broken = sum(not check.holds for check in loose)
    return f"of {len(claims)} claims {', '.join(said)}; of {len(loose)} looser forms, not claimed, {broken} do not hold"


def _gains(world: World, table: PolicyTable) -> Iterator[tuple[list[Array], BoolArray, int]]:
    """Of each layer what each of its E sensors gains by being on, `[E]`, whether it is on, and how many info states.

    Gains are by the price on every step, as printed, and in the grid alone, as the reward of eq. reward_func pays it.
    """
    for seen in followed(world, table):
        # `mass` and `inside` are joint with the misses, so both sides are divided by Pr(misses) = `before`.
        earned, cost = seen.mass * world.detects(seen.cells) * world.reward, world.cost[seen.cells]
        gains = [(earned - cost * each[seen.rows]) / seen.before[seen.rows] for each in (seen.before, seen.inside)]
        yield gains, table.on(seen.n, seen.rows, seen.cells) > 0, int((seen.before > 0).sum())


def _track_property(world: World, solution: Solution) -> Iterator[Check]:
    # Theorem tracking_property: Pr(X_{k+1} = b | s_k) > c/r is sensed.
    layers = list(_gains(world, solution.table))
    # -inf stands for "no case": max(initial=-inf) leaves it where no cell is left unsensed.
    unsensed = [[gain[~on].max(initial=-np.inf) for gain in gains] for gains, on, _ in layers]
    printed, sharp = np.max(unsensed, axis=0, initial=-np.inf)
    note = f"{sum(states for _, _, states in layers)} info states"
    yield Check("Theorem 1", "p_j > c/r is sensed: largest p_j r - c left unsensed", float(printed), note=note)
    statement = "p_j > c p_in / r is sensed: largest p_j r - c p_in left unsensed"
    yield Check("Theorem 1, sharp", statement, float(sharp))


def _tower_lemma(world: World, solution: Solution) -> Iterator[Check]:
    layers = reachable_layers(world, world.num_choices)
    sets = layer_sets(layers, solution.table)
    problem = InnerProblem.of(world, layers, solution.value)
    # `later[n]` `[E_n]`: W, what follows with the target at the entry's cell, missed, and the plan going on. `mass`
    # `[E_n]`: joint probability of being there after n misses; it begins with 1 in each located cell.
    later, mass, first = problem.undetected(sets), np.ones(world.num_cells), -np.inf
    second, closed = -np.inf, True
    known = tables(problem, slack=SLACK, run=up_to(MOST_NODES))
    for n, layer in enumerate(layers[1:]):
        mass = (mass @ layer.moves) * (1.0 - sets[n] * world.detects(layer.cells))
        missed = mass > 0
        # eq. vis_p1: E[V(x_l, n + 1, h) | X = b] = W(b) against V(b, 0, {}); only where the miss can happen.
        first = max(first, float((later[n + 1] - solution.value[layer.cells])[missed].max(initial=-np.inf)))
        # n + 1 of the t_max + 1 free sets are chosen here; after the last one the safe action leaves nothing to plan.
        if n < world.t_max:
            loss, done = _one_cell_less(problem, layer, later[n + 1], mass, known[: world.t_max - n])
            second, closed = max(second, loss), closed and done
    yield Check("Lemma 1, first", "known at b but undetected is worth at most located at b: largest excess", first)
    row = Check("Lemma 1, second", "with b sensed too, the rest is worth at least as much: largest loss", second)
    yield replace(row, closed=closed)


def _one_cell_less(
    problem: InnerProblem, layer: Layer, later: Array, mass: Array, known: list[Array]
) -> tuple[float, bool]:
    """Second inequality of Lemma 1: how much less the best plan for the mass without one missed cell earns.

    The best plan is searched for anew, from a little below what it has to reach. Second: whether that came to its end.
    """
    entries = np.flatnonzero(mass)
    # eq. vis_pr2 conditions on X being neither sensed nor b: for each missed entry e, the missed entries of the same
    # located cell without e. A row with e alone has nothing left to compare.
    others = [np.setdiff1d(entries[layer.rows[entries] == layer.rows[e]], [e]) for e in entries]
    others = [rest for rest in others if len(rest)]
    if not others:
        return -np.inf, True
    row = np.repeat(np.arange(len(others)), [len(rest) for rest in others])
    entry = np.concatenate(others)
    # `[problems, M]`: one search problem per entry taken out, since a set sensed there too would have located it.
    left = sparse.csr_array((mass[entry], (row, layer.cells[entry])), shape=(len(others), problem.world.num_cells))
    going_on = per_row(row, mass[entry] * later[entry], len(others))
    # `tree.best` is at least where it begins: begun at `going_on` itself, a loss would never show.
    tree = Tree(replace(problem, windowed=False), known, going_on - SEARCHED, SLACK, left)
    up_to(MOST_NODES)(tree)
    return float((going_on - tree.best).max()), tree.closed


def _as_pomdp(world: World) -> Iterator[Check]:
    """Theorem 2 on the world itself where it is small enough, else on its corner; at its own prices, and dearer."""
    # Every set is an action: 2^9 = 512 per belief state at most. `changed` without changes drops `max_steps` and the
    # window.
    own = changed(world) if world.num_cells <= _MOST_CELLS and world.t_max <= 1 else corner(world)
    # At low prices little is missed, and a wrong treatment of misses would hardly show; hence also at prices where
    # misses pay.
    for small, prices in ((own, "its own prices"), (dearer(own), "prices at which the safe action is used")):
        try:
            beliefs = pomdp.solve(small, most_beliefs=_MOST_BELIEFS)
        # More belief states than _MOST_BELIEFS; the corner, of at most four cells and t_max 2, has few.
        except UserError:
            small = corner(small)
            beliefs = pomdp.solve(small)
        best = optimum.solve(small, tolerance=SLACK, nodes=MOST_NODES)
        where = "the world itself" if small.num_cells == world.num_cells else f"its {CORNER}x{CORNER} corner"
        note = f"on {where}, {prices}, t_max {small.t_max}, {beliefs.beliefs} belief states"
        # Theorem thm:optimalaspomdp: V_TMDP((b, 0, {})) = V_POMDP((e_b, 0)) for every cell b.
        deviation = float(np.abs(beliefs.value - best.value).max())
        yield Check("Theorem 2", "V*_TMDP = V*_POMDP, by plans of sets and over belief states", deviation, note=note)


def corner(world: World) -> World:
    """The top left cells alone; leaving them is exiting."""
    columns = min(CORNER, world.columns)
    cells = (np.arange(min(CORNER, world.rows))[:, None] * world.columns + np.arange(columns)).ravel()
    # `[4, 4]` for a corner of 2 x 2. What led out of it is mass that is gone, which is what exit means to `World`.
    kernel = world.kernel[cells][:, cells].toarray()
    # The value is undiscounted, and finite only where the target exits. Rows above 0.99 are scaled to 0.99, since a
    # target that never leaves the corner would have no value there.
    kernel *= 0.99 / np.maximum(kernel.sum(axis=1, keepdims=True), 0.99)
    # D = N^2 c by default, so it shrinks with the number of sensors.
    share = len(cells) / world.num_cells
    sensors = {name: getattr(world, name)[cells] for name in ("cost", "detection", "safe_detection")}
    size, t_max, safe_cost = (len(cells) // columns, columns), min(world.t_max, 2), world.safe_cost * share
    return World.of(world, kernel, size=size, t_max=t_max, safe_cost=safe_cost, max_steps=None, window=None, **sensors)


def dearer(world: World) -> World:
    """The world with sensors a little dearer than the likeliest move is worth, so that misses and the clock count."""
    # Above r max P no sensor earns its price by the next reward alone: misses happen, beliefs spread and the clock
    # runs.
    cost = np.maximum(world.cost, 1.05 * world.reward * float(world.kernel.max()))
    return changed(world, cost=cost, safe_cost=max(world.safe_cost, float(cost.sum())))


def changed(world: World, **changes: Any) -> World:
    """A whole-episode copy of the world, all sensors allowed, with some arguments of its task replaced."""
    return World.of(world, world.kernel, **({"max_steps": None, "window": None} | changes))


def _estimator(world: World, solution: Solution) -> Iterator[Check]:
    if not world.perfect:  # with the others on, a miss no longer says that the target is where one sensor is off
        note = "its proof needs sensors that never miss"
        yield Check("Theorem 3, exact form", "the estimate from Q is the belief", -np.inf, note=note)
        return
    yield _from_histories(world)
    found = estimator.positions(world, solution.table, solution.value)
    # Theorem thm:estimator sets the value after a miss equal to V(x, 0, {}), which forgets the clock n + 1, and adds c
    # where the exit step costs nothing (c p_in).
    paper = max(float(np.abs(e.paper - e.belief).max(initial=0.0)) for e in found)
    scored = estimator.accuracy(world, solution.table, solution.value)
    note = f"argmax right on {scored.paper:.2%} of missed steps, the belief's on {scored.bayes:.2%}"
    # With one candidate per info state the argmax is right whatever the numbers: a rate of 100 % then proves nothing.
    if all(np.bincount(e.rows[e.missed > 0]).max(initial=0) <= 1 for e in found):
        note = "a miss leaves one cell at most, so that every argmax is right"
    statement = "the printed form is the belief (it takes W = V and charges the exit step)"
    yield Check("Theorem 3, as printed", statement, paper, expected=False, note=note)


def _from_histories(world: World) -> Check:
    """The estimate from a Q over histories against the belief filter, on the dearer corner: misses happen there."""
    small = changed(dearer(corner(world)), t_max=min(world.t_max, 1))
    solved = histories.solve_histories(small)
    worst = -np.inf
    # Forced states have no Q: nothing is chosen there.
    for state in solved.q:
        belief = histories.filtered(small, solved, state)
        for cell, estimate in histories.estimates(small, solved, state).items():
            worst = max(worst, float(abs(estimate - belief[cell])))
    note = f"on the {CORNER}x{CORNER} corner, t_max {small.t_max}, Q of {len(solved.q)} histories, without a belief"
    return Check("Theorem 3, exact form", "the estimate from Q is the belief", worst, note=note)


def _qmdp_derivation(world: World) -> Iterator[Check]:
    # Lemma lem:qmdp_pol: Q_MDP's action separates into the sensors, each on iff p r >= c (or c p_in, as the reward
    # charges).
    for in_grid, threshold in ((False, "c/r"), (True, "c p_in / r")):
        # Switching a sensor on gains `gain`, switching it off -gain; none may be positive.
        layers = ((gains[in_grid], on) for gains, on, _ in _gains(world, qmdp.solve(world, in_grid=in_grid)))
        worst = max(float(np.where(on, -gain, gain).max(initial=-np.inf)) for gain, on in layers)
        yield Check("Q_MDP", f"threshold {threshold}: largest gain of switching one sensor over", worst)
    # eq. upper_bound_v at a known position, gamma = 1: V(x) = sum_j max(P_xj r - c_j, 0) + sum_j P_xj V(j).
    value, move = bounds.paper(world), world.kernel
    earned = move.data * world.detects(move.indices) * world.reward
    gain = np.maximum(earned - world.cost[move.indices], 0.0)
    residual = per_row(row_index(move), gain, world.num_cells) + move @ value - value
    yield Check("Q_MDP", "V*_QMDP as printed solves its equation: largest residual", float(np.abs(residual).max()))


def _order(world: World, solution: Solution) -> Iterator[Check]:
    # Each relaxes the next: play without knowing, known with the clock, known without it. The inequality holds cell by
    # cell, so the largest difference over start cells is what is checked; the notes give the means, which are AIHTRs.
    upper, valid = bounds.clocked(world), bounds.valid(world)
    gap = f"gap {solution.upper - solution.lower:.2g}"
    best = solution.bound
    others = evaluate(world, qmdp.solve(world)).value
    yield Check("order", "Q_MDP <= optimum", float((others - best).max()), note=f"optimum {solution.lower:.6f}, {gap}")
    yield Check("order", "optimum <= clocked bound", float((solution.value - upper).max()), note=f"{upper.mean():.6f}")
    yield Check("order", "clocked bound <= valid bound", float((upper - valid).max()), note=f"{valid.mean():.6f}")
    printed = bounds.paper(world)
    statement = "optimum <= the printed bound (it charges sensors on the exit step)"
    note = f"{printed.mean():.6f}"
    yield Check("order", statement, float((solution.value - printed).max()), expected=False, note=note)


def _support(tolerance: float) -> Check:
    # The paper's remark: at c = 0.14 both probabilities of Z = 4, 0.15 and (1 - 0.15 - 0.005) / 3 = 0.28, exceed c/r.
    # Renormalizing at the border only raises them, so that the remark holds for every draw; this is one.
    world = paper_world(paper_kernel(4, seed=4, border="renormalize"), 0.14, 1)
    support = world.kernel.toarray() > 0
    best, simple = optimum.solve(world), qmdp.solve(world)
    # `[M, M]` sets of n = 0 alone: where the support is sensed no miss follows, and later sets are never used.
    wrong = sum(int((table.dense()[:, 0] != support).sum()) for table in (best.table, simple))
    missed = 1.0 - best.evaluation.accuracy
    # One wrong sensor already counts as 1, far above any tolerance.
    deviation = max(float(wrong), missed)
    statement = "optimum and Q_MDP sense exactly the support, accuracy 100 %: sensors that differ"
    return Check("remark, c = 0.14, Z = 4", statement, deviation, deviation <= tolerance, note="N = 10, t_max 1")


def _printed_bound(tolerance: float) -> Check:
    # One counter-example is enough: the printed bound charges c for every sensor on the exit step, the reward does
    # not.
    world = paper_world(paper_kernel(5, seed=5, border="inside"), 0.16, 5)
    printed, achieved = bounds.paper(world).mean(), evaluate(world, qmdp.clocked_policy(world)).aihtr
    note = f"bound {printed:.2f}, a policy attains {achieved:.2f} (border inside, Z = 5, c = 0.16, t_max 5)"
    statement = "no policy exceeds the printed bound"
    excess = float(achieved - printed)
    return Check("the printed bound", statement, excess, excess <= tolerance, expected=False, note=note)
