"""Points where the paper is silent, loose or wrong, each with computed figures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from trackmdp.paper import remarks, theorems
from trackmdp.paper.theorems import Check
from trackmdp.paper.worlds import COSTS, paper_kernel, paper_world
from trackmdp.reports.grouping import Study
from trackmdp.reports.tables import Cell, Column, Table
from trackmdp.solvers import optimal

TOLERANCE = 1e-9
# Z = 5 is where Q_MDP fails: each likely move has (1 - 0.15 - 0.005) / 4 = 0.211, below c/r = 0.22.
HARDEST = 5


def checks(seed: int, *, border: str, t_max: int) -> list[Check]:
    """The paper's theorems on the world with Z = 5 at the lowest price, and the two remarks."""
    world = paper_world(paper_kernel(HARDEST, seed, border), COSTS[0], t_max)  # type: ignore[arg-type]
    solution = optimal.solve(world, tolerance=TOLERANCE)
    return [*theorems.check_theorems(world, solution, TOLERANCE), *remarks.check_remarks(TOLERANCE)]


def checks_table(found: Iterable[Check]) -> Table:
    """Every statement checked, with its largest deviation; -inf where there was no case to check."""
    rows: list[list[Cell]] = [
        [c.name, c.statement, None if c.deviation == float("-inf") else f"{c.deviation:.1e}", c.verdict, c.note]
        for c in found
    ]
    columns = [Column("theorem"), Column("statement"), Column("largest deviation"), Column("verdict"), Column("note")]
    return Table("theorems", f"The paper's statements on the world with Z = {HARDEST}, c = {COSTS[0]}", columns, rows)


def bounds_table(study: Study, pairs: Mapping[tuple[int, float], str]) -> Table:
    """The bounds of each pair beside the optimum: where the printed one is below what a policy earns."""
    rows: list[list[Cell]] = []
    for (support_size, cost), world in pairs.items():
        # Bounds are the world's, so that any run has them; the bracket of the optimum is the best that some run found.
        run, best, upper = study.in_world(world)[0], study.lower(world), study.upper(world)
        printed = run.figure("bound_paper")
        # Relative: the solver's bracket is closed to rounding of values that grow with the episode's length.
        proved = None if best is None else upper - best <= 1e-6 * max(1.0, abs(best))
        # eq. upper_bound_v charges sensors on the exit step, the reward (eq. reward_func) does not: a policy may earn
        # more.
        below = None if best is None else best > printed + 1e-9
        row: list[Cell] = [support_size, cost, run.figure("qmdp_aihtr"), best, upper, proved]
        rows.append([*row, run.figure("bound_clocked"), run.figure("bound_valid"), printed, below])
    columns = [Column("Z"), Column("c", 2), Column("Q_MDP", 3), Column("optimum, attained", 4)]
    columns += [Column("optimum, at most", 4), Column("proved"), Column("clocked bound", 3), Column("valid bound", 3)]
    columns += [Column("printed bound", 3), Column("printed bound is exceeded")]
    return Table("bounds", "AIHTR: Q_MDP, the proved bracket of the optimum, and the bounds, exactly", columns, rows)


def points(study: Study, pairs: Mapping[tuple[int, float], str], found: Sequence[Check]) -> list[tuple[str, str]]:
    """(heading, text) of each point, in the order of the paper."""
    return [
        (
            "Unstated settings",
            "T_max, the kernels and what becomes of positions outside the grid are not given. The kernels are chosen "
            "by one rule from the printed accuracy of Q_MDP; above is how far the choice moves each figure.",
        ),
        ("The price on the exit step", _exit_price(study, pairs, found)),
        (
            "Theorem 1",
            "The printed threshold is c/r; with the price charged only in the grid, the sharp one is c·p_in/r.",
        ),
        ("Theorem 3", _theorem_three(found)),
        ("Indices", "Several equations carry a_k where a_{k+1} is meant (belief update, state transition)."),
        (
            "Accuracy",
            "Fraction of perfect observations in an episode: here the exact pooled ratio over steps in the grid; the "
            "located start and the exit step do not count.",
        ),
        ("The safe action", "A policy that turns every sensor on pays c·N²; only the forced action pays D."),
        ("Z = 5, c = 0.22", _hardest(study, pairs)),
    ]


def _exit_price(study: Study, pairs: Mapping[tuple[int, float], str], found: Sequence[Check]) -> str:
    table = bounds_table(study, pairs)
    # `is True`: the last column is None where no optimum is known.
    exceeded = [f"(Z = {row[0]}, c = {row[1]:g})" for row in table.rows if row[-1] is True]
    remark = next((check.note for check in found if check.name == "the printed bound"), "")
    return (
        "The reward multiplies everything by the indicator of being in the grid, so sensors cost nothing on the exit "
        "step; the printed bound charges them there, and is no bound. Here it lies below a policy's exact value in "
        f"{len(exceeded)} of {len(table.rows)} pairs: {', '.join(exceeded) or 'none'}. With the border rule that keeps "
        f"all positions inside: {remark}. The valid bound and the clocked bound charge like the reward."
    )


def _theorem_three(found: Sequence[Check]) -> str:
    printed, exact = (
        next(check for check in found if check.name == f"Theorem 3, {form}") for form in ("as printed", "exact form")
    )
    return (
        "The printed estimator takes the value after a miss for that after a detection, but the clock differs. Its "
        f"largest error against the belief is {printed.deviation:.2g}, that of the exact form, with a Q computed "
        f"without any belief, {exact.deviation:.1e} ({exact.note}); {printed.note}."
    )


def _hardest(study: Study, pairs: Mapping[tuple[int, float], str]) -> str:
    """How tight the clocked bound is, and where it is not attained."""
    short = {}
    for (support_size, cost), world in pairs.items():
        bound, best = study.in_world(world)[0].figure("bound_clocked"), study.lower(world)
        # U is the optimum where its policy leaves at most one cell of positive probability unsensed; elsewhere the
        # optimum takes a search, and may lie below.
        if best is not None and bound - best > 1e-6 * max(1.0, abs(bound)):
            short[f"Z = {support_size}, c = {cost:g}"] = bound - best
    missed = "; ".join(f"{pair} (by {gap:.3f})" for pair, gap in short.items())
    return (
        "Away from the border every probability lies below c/r, so Q_MDP senses nothing until it is forced: the drop "
        f"in the figure. The clocked bound is attained by a policy in {len(pairs) - len(short)} of {len(pairs)} pairs"
        + (f"; not in {missed}, where the optimum takes a search." if missed else ".")
    )
