"""Sensors with footprints: coverage problems, exact values, bounds and planners against brute force over sets."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from tests.helpers import random_kernel, small_world
from tests.solvers.footprints import best_of_chains, tiny_world, value_of_chains
from trackmdp.errors import UserError
from trackmdp.policies.table import PolicyTable
from trackmdp.solvers import bounds, lookahead, optimal, qmdp
from trackmdp.solvers.cover import Covering
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.layers import policy_table, reachable_layers
from trackmdp.solvers.recorded import replay
from trackmdp.solvers.renewal import row_index
from trackmdp.solvers.search import InnerProblem
from trackmdp.solvers.solve import solve
from trackmdp.solvers.two_sets import best_plans
from trackmdp.world.coverage import Coverage
from trackmdp.world.model import World
from trackmdp.world.tracks import Tracks

PLANNERS = (qmdp.clocked_policy, qmdp.solve, qmdp.fcr, qmdp.myopic)


def _turned(world: World) -> World:
    """The same sensors in the opposite order, which are footprints to a task: sensor s covers cell M - 1 - s."""
    return World.of(world, world.kernel, coverage=np.eye(world.num_cells)[::-1], cost=world.cost[::-1])


def _prices_and_gains(seed: int) -> tuple[World, Covering, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    world = tiny_world(seed)
    covering = Covering.of(world, row_index(world.kernel), world.kernel.indices)
    assert covering is not None
    # Some gains are losses: what a set must not see.
    gain = rng.normal(0.3, 0.4, world.kernel.nnz) * world.kernel.data
    return world, covering, gain, covering.price(0.2 * rng.random(world.total_sensors), np.ones(world.num_cells))


def _most(world: World, covering: Covering, gain: np.ndarray, price: np.ndarray) -> np.ndarray:
    """`[M]`, the best of all sets."""
    assert world.coverage is not None
    rows, cells, covers = row_index(world.kernel), world.kernel.indices, world.coverage.matrix.toarray()
    best = np.full(world.num_cells, -np.inf)
    for choice in itertools.product([False, True], repeat=world.total_sensors):
        on = np.array(choice)
        paid = np.bincount(covering.rows, price * on[covering.sensors], world.num_cells)
        best = np.maximum(best, np.bincount(rows, gain * covers[on].any(0)[cells], world.num_cells) - paid)
    return best


def test_three_overlapping_sensors_by_hand() -> None:
    """From the one cell the target goes to cells 1 2 3 with .3 each; sensors cover 1 2, 2 3 and all three."""
    kernel = np.zeros((4, 4))
    kernel[0, 1:] = 0.3
    coverage = np.array([[0, 1, 1, 0], [0, 0, 1, 1], [0, 1, 1, 1]])
    world = World(kernel, (1, 4), cost=[0.2, 0.2, 0.5], t_max=0, safe_cost=1.0, coverage=coverage)
    covering = Covering.of(world, row_index(world.kernel), world.kernel.indices)
    assert covering is not None
    gain, price = world.kernel.data, covering.price(world.cost, np.ones(4))
    # Both small ones see all for .4, the large one for .5; one of them alone .6 for .2: .5 > .4, .4.
    assert covering.sensors[covering.greedy(gain, price)].tolist() == [0, 1]
    assert covering.best(gain, price, exact=True).upper == pytest.approx([0.9 - 0.4, 0, 0, 0])


def test_of_sensors_that_see_the_same_the_cheapest_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    """From the one cell the target goes to cells 1 2 3 with .3 each, never to cell 4, which some cover as well."""
    kernel = np.zeros((5, 5))
    kernel[0, 1:4] = 0.3
    coverage = np.array([[0, 1, 1, 0, 0], [0, 1, 1, 0, 1], [0, 1, 1, 0, 0], [0, 0, 0, 1, 1], [0, 0, 0, 1, 0]])
    world = World(kernel, (1, 5), cost=[0.3, 0.1, 0.1, 0.2, 0.1], t_max=0, safe_cost=1.0, coverage=coverage)
    covering = Covering.of(world, row_index(world.kernel), world.kernel.indices)
    assert covering is not None
    gain, price = world.kernel.data, covering.price(world.cost, np.ones(5))
    assert covering.sensors[covering.distinct(price)].tolist() == [1, 4]
    for on in (covering.greedy(gain, price), covering.best(gain, price).on, covering.best(gain, price, exact=True).on):
        assert covering.sensors[on > 0].tolist() == [1, 4]
    # 3 sensors see cell 1, 3 cell 2 and 2 cell 3
    monkeypatch.setattr("trackmdp.solvers.cover._MOST", 7)
    with pytest.raises(UserError, match=r"coverage: 8 pairs of a cell .* expected at most 7"):
        Covering.of(world, row_index(world.kernel), world.kernel.indices)


@pytest.mark.parametrize("seed", range(40))
def test_sets_and_bounds_of_coverage_problems(seed: int) -> None:
    world, covering, gain, price = _prices_and_gains(seed)
    most = _most(world, covering, gain, price)
    relaxed, exact = covering.best(gain, price), covering.best(gain, price, exact=True)
    assert (relaxed.upper >= most - 1e-12).all()
    assert exact.upper == pytest.approx(most, abs=1e-9)
    assert covering.worth(exact.on > 0, gain, price) == pytest.approx(most, abs=1e-9)
    good = covering.worth(covering.greedy(gain, price), gain, price)
    assert (good <= most + 1e-12).all()
    assert good.sum() >= 0.9 * most.sum()
    on = np.random.default_rng(seed).random(len(price)) < 0.5
    assert (covering.worth(covering.improve(on, gain, price), gain, price) >= np.maximum(good, 0) - 1e-12).all()


@pytest.mark.parametrize("seed", range(12))
def test_bounds_and_planners_against_all_chains(seed: int) -> None:
    world = tiny_world(seed)
    best, linear, exact = best_of_chains(world), bounds.clocked_table(world), bounds.exact_clocked_table(world)
    for upper in (linear.value, exact.value, bounds.valid(world)):
        assert (upper >= best - 1e-8).all()
    assert (exact.value <= linear.value + 1e-7).all()
    short = replace(world, max_steps=4)
    most = bounds.clocked(short)
    for plan in PLANNERS:
        assert (evaluate(world, plan(world)).value <= best + 1e-8).all()
        assert (evaluate(short, plan(short)).value <= most + 1e-8).all()
    solution = optimal.solve(world)
    assert solution.value == pytest.approx(best, abs=1e-7)
    assert (solution.bound >= best - 1e-8).all()
    assert solution.certified
    if world.t_max == 0:  # one set from each cell: the bound that reveals the cell is the optimum
        assert exact.value == pytest.approx(best, abs=1e-7)
    else:
        _all_plans_are_looked_at(world, best)


def _all_plans_are_looked_at(world: World, best: np.ndarray) -> None:
    """From sensing nothing, the plans found for the optimum's values are those of the optimum."""
    layers = reachable_layers(world, 2)
    problem, looked = InnerProblem.of(world, layers, best), []
    found = best_plans(problem, problem.none_sensed(), 1e-9, lambda plans: looked.append(plans) is None)
    assert found is not None
    assert found[0] == pytest.approx(best, abs=1e-7)
    assert evaluate(world, policy_table(world, layers, found[1])).value == pytest.approx(best, abs=1e-7)
    assert best_plans(problem, problem.none_sensed(), 1e-9, lambda _: False) is None or not looked


def test_values_are_those_of_stepping_through_the_chains() -> None:
    for seed in range(20):
        world, rng = tiny_world(seed), np.random.default_rng(seed)
        chains = rng.random((world.num_cells, world.num_choices, world.total_sensors)) < 0.5
        assert evaluate(world, chains).value == pytest.approx(value_of_chains(world, chains), abs=1e-9)


def test_footprints_of_one_cell_in_another_order_are_the_papers_sensors() -> None:
    rng = np.random.default_rng(5)
    world = World(random_kernel(rng, 9, 0.1), 3, cost=0.2 * rng.random(9), t_max=1, safe_cost=2.0)
    turned = _turned(world)
    assert turned.coverage is not None
    for plan in PLANNERS:
        mine, other = plan(world), plan(turned)
        assert (mine.dense() == other.dense()[..., ::-1]).all()
        assert evaluate(turned, other).value == pytest.approx(evaluate(world, mine).value, abs=1e-12)
    for bound in (bounds.paper, bounds.valid, bounds.clocked):
        assert bound(turned) == pytest.approx(bound(world), abs=1e-9)
    probability = rng.random((9, 2, 9))
    drawn = PolicyTable.from_dense(world, probability), PolicyTable.from_dense(turned, probability[..., ::-1])
    assert evaluate(turned, drawn[1]).value == pytest.approx(evaluate(world, drawn[0]).value, abs=1e-12)


def test_the_identity_is_no_footprint_at_all() -> None:
    world = small_world()
    same = World.of(world, world.kernel, coverage=np.eye(9))
    assert same.coverage is None
    assert np.array_equal(evaluate(same, qmdp.solve(same)).value, evaluate(world, qmdp.solve(world)).value)


def test_policies_that_draw_see_a_cell_unless_all_its_sensors_are_off() -> None:
    coverage = Coverage.of(np.array([[1, 1, 0, 0], [0, 1, 1, 0], [0, 1, 0, 0]]), 4)
    assert coverage is not None
    assert coverage.share(0.5, None) == pytest.approx([0.5, 0.875, 0.5, 0.0])
    # Of two of three sensors: one given sensor is among them with 2/3, and some of three always.
    assert coverage.share(2 / 3, 2) == pytest.approx([2 / 3, 1.0, 2 / 3, 0.0])
    kernel = np.full((4, 4), 0.2)
    world = World(kernel, 2, cost=0.1, t_max=0, safe_cost=0.5, coverage=coverage)
    every_pair = [PolicyTable.from_dense(world, np.tile(~np.eye(3, dtype=bool)[s], (4, 1, 1))) for s in range(3)]
    # One step, then the safe action: the reward of drawing a pair is the mean of those of the three pairs.
    each = [evaluate(replace(world, max_steps=1), policy).aihtr for policy in every_pair]
    drawn = evaluate(replace(world, max_steps=1), PolicyTable(world, probability=2 / 3, k=2))
    assert drawn.aihtr == pytest.approx(np.mean(each))
    assert drawn.sensors_per_step == pytest.approx(2.0)


def test_recorded_tracks_are_replayed_with_footprints() -> None:
    """From cell 0 to 3 on a line, and out: the sensor of cells 1 and 2 sees two of three steps, for .25 each."""
    world = World(np.diag(np.full(3, 0.9), 1), (1, 4), cost=0.25, t_max=3, safe_cost=2.0, coverage=[[0, 1, 1, 0]])
    tracks = Tracks(np.array([0, 1, 2, 3]), np.array([0, 4]), np.array([True]), np.array([0]))
    found = replay(world, tracks, PolicyTable.all_on(world))
    assert found.totals[0, 0] == pytest.approx(2 - 3 * 0.25)


def test_what_knows_no_footprints_says_so() -> None:
    world = tiny_world(0)
    with pytest.raises(UserError, match="expected clocked or optimal"):
        lookahead.solve(world)
    with pytest.raises(UserError, match="block=2"):
        solve(world, block=2)
    with pytest.raises(UserError, match="one cell"):
        evaluate(world, PolicyTable.all_on(world), false_alarm=0.1)
    with pytest.raises(UserError, match="other footprints"):
        evaluate(world, PolicyTable.all_on(World.of(world, world.kernel, coverage=None, cost=0.1)))
