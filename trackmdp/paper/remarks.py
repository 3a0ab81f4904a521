"""Two remarks of the paper, each on one world: Q_MDP is optimal at c = 0.14; no policy exceeds the printed bound."""

from __future__ import annotations

from collections.abc import Iterator

from trackmdp.paper.theorems import Check
from trackmdp.paper.worlds import paper_kernel, paper_world
from trackmdp.solvers import bounds, clocked, optimal, qmdp
from trackmdp.solvers.evaluate import evaluate


def check_remarks(tolerance: float) -> Iterator[Check]:
    """Both remarks, each with its figures."""
    yield _support(tolerance)
    yield _printed_bound(tolerance)


def _support(tolerance: float) -> Check:
    # The paper's remark: at c = 0.14 both probabilities of Z = 4, 0.15 and (1 - 0.15 - 0.005) / 3 = 0.28, exceed c/r.
    # Renormalizing at the border only raises them, so that the remark holds for every draw; this is one.
    world = paper_world(paper_kernel(4, seed=4, border="renormalize"), 0.14, 1)
    support = world.kernel.toarray() > 0
    best, simple = optimal.solve(world), qmdp.solve(world)
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
    printed, achieved = bounds.paper(world).mean(), evaluate(world, clocked.solve(world)).aihtr
    note = f"bound {printed:.2f}, a policy attains {achieved:.2f} (border inside, Z = 5, c = 0.16, t_max 5)"
    statement = "no policy exceeds the printed bound"
    excess = float(achieved - printed)
    return Check("the printed bound", statement, excess, excess <= tolerance, expected=False, note=note)
