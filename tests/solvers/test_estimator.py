"""Theorem 3 in both forms, against the belief filter and against a walk through all paths."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings

from tests.solvers.worlds import paper_world, tiny_worlds
from trackmdp.arrays.types import BoolArray
from trackmdp.policies.table import PolicyTable
from trackmdp.solvers import estimator, optimal, rules
from trackmdp.solvers.evaluate import evaluate
from trackmdp.world.model import World


@given(tiny_worlds(most_t_max=2))
def test_the_exact_form_is_the_belief(world: World) -> None:
    solution = optimal.solve(world, tolerance=1e-9)
    for estimate in estimator.positions(world, solution.table, solution.value):
        np.testing.assert_allclose(estimate.exact, estimate.belief, rtol=0, atol=1e-8)


@settings(max_examples=25)
@given(tiny_worlds(most_t_max=1))
def test_the_belief_is_that_of_all_paths(world: World) -> None:
    table = rules.qmdp(world)
    chains = table.dense()
    for estimate in estimator.positions(world, table, evaluate(world, table).value):
        for x, cell, belief in zip(estimate.rows, estimate.cells, estimate.belief, strict=True):
            assert belief == pytest.approx(_by_paths(world, chains, int(x), estimate.n, int(cell)))


def _by_paths(world: World, chains: BoolArray, x: int, n: int, cell: int) -> float:
    """Pr(next = cell | n misses from x), summed path by path."""
    ends: dict[int, float] = {}
    for path in itertools.product(range(world.num_cells), repeat=n + 1):
        p = float(np.prod([world.kernel[a, b] for a, b in itertools.pairwise((x, *path))]))
        if not any(chains[x, t, path[t]] for t in range(n)):
            ends[path[-1]] = ends.get(path[-1], 0.0) + p
    missed = sum(
        float(np.prod([world.kernel[a, b] for a, b in itertools.pairwise((x, *path))]))
        for path in itertools.product(range(world.num_cells), repeat=n)
        if not any(chains[x, t, path[t]] for t in range(n))
    )
    return ends[cell] / missed


def test_both_forms_by_hand() -> None:
    """From 0 to 1 (0.5) or 2 (0.3), then exit; r = 1, c = 0.9, D = 2: nothing is sensed, and V(1) = V(2) = 0.

    W = 0 as well (the target exits before the safe action), so Q(s, ã) - Q(s, ã_x) = p - 0.9 · 0.8.
    """
    kernel = np.zeros((4, 4))
    kernel[0, 1], kernel[0, 2] = 0.5, 0.3
    world = World(kernel, 2, cost=np.full(4, 0.9), safe_cost=2.0, t_max=0)
    table = PolicyTable.none(world)
    (estimate,) = estimator.positions(world, table, evaluate(world, table).value)
    assert estimate.rows.tolist() == [0, 0]
    assert estimate.cells.tolist() == [1, 2]
    np.testing.assert_allclose(estimate.belief, [0.5, 0.3])
    np.testing.assert_allclose(estimate.exact, [0.5, 0.3])
    np.testing.assert_allclose(estimate.paper, [0.5 + 0.9 * 0.2, 0.3 + 0.9 * 0.2])
    scored = estimator.accuracy(world, table, evaluate(world, table).value)
    assert scored.missed_per_episode == pytest.approx(0.25 * 0.8)
    assert scored.bayes == pytest.approx(0.5 / 0.8)


def test_accuracy_on_missed_steps() -> None:
    """Missed steps are those of the exact evaluation; the exact form is as good as the belief, the paper's is not."""
    world = paper_world(5, 0.22, 2)
    chains = rules.qmdp(world)
    exact = evaluate(world, chains)
    scored = estimator.accuracy(world, chains, exact.value)
    assert scored.missed_per_episode == pytest.approx((exact.steps - exact.detections).mean())
    assert scored.exact == pytest.approx(scored.bayes, abs=1e-9)
    assert scored.paper < scored.bayes - 0.01
    assert scored.bayes < 0.3


def test_nothing_missed_is_all_right() -> None:
    world = paper_world(5, 0.16, 0)
    table = PolicyTable.all_on(world)
    scored = estimator.accuracy(world, table, evaluate(world, table).value)
    assert (scored.paper, scored.exact, scored.bayes, scored.missed_per_episode) == (
        1.0,
        1.0,
        1.0,
        0.0,
    )
