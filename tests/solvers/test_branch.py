"""Branch and bound stopped anywhere: what it claims to have proved, it has."""

from __future__ import annotations

import numpy as np

from tests.solvers.worlds import paper_world
from trackmdp.solvers import optimal, search
from trackmdp.solvers.branch import Tree
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.known import tables
from trackmdp.solvers.layers import reachable_layers
from trackmdp.solvers.search import InnerProblem
from trackmdp.solvers.solution import SearchProgress


def _tree() -> tuple[Tree, np.ndarray, np.ndarray]:
    """The renewals of the policy that the homotopy finds at Z = 5, c = 0.22, t_max = 2: some can be improved."""
    world = paper_world(5, 0.22, 2)
    value = evaluate(world, search.solve(world)).value
    problem = InnerProblem.of(world, reachable_layers(world, 3), value)
    known = tables(world, problem.detected, problem.missed, 2, slack=1e-9, go_on=lambda _: True)
    tree = Tree(world, problem.detected, known, value, 1e-9)
    closed = Tree(world, problem.detected, known, value, 1e-9)
    closed.run(lambda _: True)
    return tree, value, closed.best


def test_the_bound_holds_wherever_the_search_is_stopped_and_only_falls() -> None:
    tree, value, best = _tree()
    assert (best > value + 1e-6).any()
    last = np.full(len(value), np.inf)
    for most_nodes in (0, 10, 100, 1000, 10_000, 100_000):
        tree.run(lambda tree, most=most_nodes: tree.nodes < most)
        assert (tree.best <= best + 1e-9).all()
        assert (tree.upper() >= best - 1e-9).all()
        assert (tree.upper() <= last + 1e-12).all()
        last = tree.upper()
    assert tree.closed
    np.testing.assert_allclose(tree.best, best)
    assert (tree.upper() <= tree.best + 1e-9).all()


def test_improvements_are_the_chains_that_earn_what_is_claimed() -> None:
    """For each cell with a better chain: sense all possible cells but those left out, and the worth comes out."""
    tree, value, _ = _tree()
    tree.run(lambda _: True)
    world = paper_world(5, 0.22, 2)
    detected = world.reward + value
    better, left_out = tree.improvements()
    assert better.any()
    for x in np.flatnonzero(better):
        mass, worth = np.eye(100)[x], 0.0
        for left in left_out:
            mass = mass @ world.kernel
            sensed = (mass > 0) & ~left.has(np.full(100, x), np.arange(100))
            worth += float(mass[sensed] @ detected[sensed] - 0.22 * sensed.sum() * mass.sum())
            mass = np.where(sensed, 0.0, mass)
        worth += float((mass @ world.kernel) @ (detected - world.safe_cost))
        np.testing.assert_allclose(worth, tree.best[x], rtol=1e-12)


def test_a_search_cut_short_keeps_a_bracket_around_the_optimum() -> None:
    """Interrupted at every report, one later each time: the certified optimum lies in every bracket."""
    world = paper_world(5, 0.22, 2)
    best = optimal.solve(world).lower
    for reports in (1, 2, 3):
        left = iter(range(reports))

        def stop(_: SearchProgress, left: object = left) -> None:
            if next(left, None) is None:  # type: ignore[call-overload]
                raise KeyboardInterrupt

        solution = optimal.solve(world, on_progress=stop)
        assert solution.lower <= best + 1e-9
        assert solution.upper >= best - 1e-9
