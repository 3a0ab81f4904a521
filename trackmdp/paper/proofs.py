"""Checks of the program itself: values, bounds and branch and bound against `exhaustive`, in worlds of a few cells.

`_search` is the one place that knows how branch and bound is called.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from trackmdp.arrays.types import Array
from trackmdp.paper.check import NO_CASE, Check
from trackmdp.paper.exhaustive import best_worth, clocked_value, policy_value, revealed_value
from trackmdp.policies.table import PolicyTable
from trackmdp.solvers import bounds, optimal, pomdp, rules
from trackmdp.solvers.certify.inner import InnerProblem
from trackmdp.solvers.certify.known import planted, up_to
from trackmdp.solvers.renewal import Renewal
from trackmdp.solvers.value import value_of
from trackmdp.world.model import World

BUDGETS = (1, 10, 100, 1_000_000)
"""Choices after which a search is cut; the last one ends it."""
_SLACK = 1e-10


def of_values(small: World) -> Iterator[Check]:
    """Exact values against those of the chain of states, for a drawn policy, with and without misses."""
    rng = np.random.default_rng(0)
    worlds = (small, small.but(detection=0.8, safe_detection=0.7))
    worst = NO_CASE
    for world in worlds:
        sets = rng.random((world.num_keys, world.num_choices, world.num_cells)) < 0.5
        policy = PolicyTable.from_dense(world, sets)
        error = np.abs(value_of(world, policy).value - policy_value(world, policy))
        worst = max(worst, float(error.max()))
    statement = (
        "the exact value of a policy equals the chain's over (state, last detection, misses)"
    )
    note = f"on the corner, a drawn policy, with and without misses, {len(worlds)} worlds"
    yield Check("value", statement, worst, note=note).of_cases(1)


def of_bounds(small: World) -> Iterator[Check]:
    """The clocked and the valid bound against value iteration."""
    for kind, bound, expected in (
        ("valid", bounds.valid(small), revealed_value(small)),
        ("clocked", bounds.clocked(small), clocked_value(small)),
    ):
        error = float(np.abs(bound - expected).max())
        yield Check("bound", f"the {kind} bound solves its equation", error, note="on the corner")


def of_searches() -> Iterator[Check]:
    """Branch and bound over a poor policy, in worlds that need it, against all plans and the POMDP's optimum."""
    tree = payment = bracket = NO_CASE
    for world in searched_worlds():
        value = value_of(world, rules.qmdp(world)).value
        exact = best_worth(world, value, np.eye(world.num_cells), world.num_choices)
        optimum = pomdp.solve(world).value
        for nodes in BUDGETS:
            best, upper, proved = _search(world, value, nodes)
            tree = max(tree, float((exact - upper).max()))
            payment = max(payment, float((optimum - proved).max()))
            solved = optimal.solve(world, nodes=nodes)
            outside = (optimum - solved.bound).max(), (solved.value - optimum).max()
            bracket = max(bracket, *map(float, outside))
        # The last search came to its end.
        tree = max(tree, float(np.abs(best - exact).max()))
    note = "over Q_MDP's policy on 2 x 2 cells, cut early and searched to the end"
    for statement, deviation in (
        ("branch and bound has the best of all plans, and no bound below it", tree),
        (
            "the bound that branch and bound proves of any policy is above the POMDP's optimum",
            payment,
        ),
        ("the POMDP's optimum is in the bracket of solve", bracket),
    ):
        yield Check("search", statement, deviation, note=note).of_cases(1)


def searched_worlds() -> Iterator[World]:
    """2 x 2 cells, from each of which the target may go anywhere, so that plans of several sets need a search."""
    for t_max, detection in ((1, 1.0), (2, 1.0), (1, 0.8)):
        kernel = 0.95 * np.random.default_rng(t_max).dirichlet(np.full(4, 3.0), size=4)
        yield World(kernel, 2, cost=0.25, t_max=t_max, detection=detection)


def _search(world: World, value: Array, nodes: int) -> tuple[Array, Array, Array]:
    """`[M]` each, after `nodes` choices, V = `value` being the worth of a detection.

    The best plan found from each cell, the bound on any plan, and the bound on the optimum that this proves.
    """
    problem = InnerProblem.of(Renewal(world, world.motion), value)
    tree = planted(problem, value, _SLACK, up_to(BUDGETS[-1]))
    up_to(nodes)(tree)
    # e pays for the improvement of every plan, step by step (`optimal.payment`): V + (I - P)^-1 e is above V*.
    paid = np.linalg.solve(
        np.eye(world.num_cells) - world.kernel.toarray(), optimal.payment(tree, value)
    )
    return tree.best, tree.upper(), value + paid
