"""The certified optimum and the searches on the way to it."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings

from tests.solvers.worlds import (
    PAPER_REFERENCES,
    REFERENCES,
    best_of_all,
    paper_world,
    reference_world,
    searched,
    tiny_worlds,
)
from trackmdp.arrays.types import BoolArray
from trackmdp.motion.kernels import drift, random_walk
from trackmdp.policies.table import PolicyTable
from trackmdp.solvers import bounds, optimal
from trackmdp.solvers.certify import delayed
from trackmdp.solvers.certify.branch import Tree
from trackmdp.solvers.certify.inner import InnerProblem
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.renewal import Renewal
from trackmdp.solvers.search import Found
from trackmdp.solvers.solution import SearchProgress
from trackmdp.solvers.solve import solve
from trackmdp.world.make import make_world
from trackmdp.world.model import World


def assert_optimal(world: World, best: np.ndarray, tolerance: float = 1e-9) -> None:
    solution = optimal.solve(world, tolerance=tolerance)
    scale = 1.0 + np.abs(best).max()
    assert solution.certified
    np.testing.assert_allclose(solution.value, best, rtol=0, atol=2 * tolerance * scale)
    np.testing.assert_allclose(
        solution.value, evaluate(world, solution.table).value, rtol=0, atol=1e-12 * scale
    )
    assert (best <= solution.bound + 1e-9 * scale).all()
    assert solution.lower <= solution.upper


@pytest.mark.parametrize("reference", REFERENCES, ids=lambda row: row["name"])
def test_reference_values(reference: dict) -> None:
    world = reference_world(reference)
    assert_optimal(world, np.array(reference["optimal_value"]))
    assert evaluate(world, optimal.solve(world).table).accuracy == pytest.approx(
        reference["optimal_accuracy"], abs=1e-9
    )


@pytest.mark.parametrize(
    "row",
    PAPER_REFERENCES,
    ids=lambda row: f"Z{row['support_size']}-c{row['cost']}-T{row['t_max']}",
)
def test_the_papers_worlds_are_certified(row: dict) -> None:
    world = paper_world(row["support_size"], row["cost"], row["t_max"])
    solution = optimal.solve(world)
    assert solution.certified
    assert solution.upper - solution.lower <= 1e-6 * max(1.0, abs(solution.lower))
    assert solution.lower == pytest.approx(row["best_known"], abs=1e-7)


@given(tiny_worlds(most_t_max=2))
def test_every_chain_of_a_2x2_world_tried(world: World) -> None:
    assert_optimal(world, best_of_all(world))


@settings(max_examples=10)
@given(tiny_worlds(size=3, most_t_max=1, support=3))
def test_every_chain_of_a_3x3_world_tried(world: World) -> None:
    assert_optimal(world, best_of_all(world))


@given(tiny_worlds(most_t_max=2))
def test_the_search_ends_where_no_single_set_can_be_improved(world: World) -> None:
    table = searched(world)
    value = evaluate(world, table).value
    renewal = Renewal(world, world.motion)
    sets = renewal.sets(table)
    np.testing.assert_array_equal(renewal.table(sets).dense(), table.dense())
    problem = InnerProblem.of(renewal, value)
    worth = problem.plans().worth_of(sets)
    np.testing.assert_allclose(worth, value, rtol=1e-9, atol=1e-9)
    ascended = problem.plans().ascend(sets, sweeps=1)
    np.testing.assert_allclose(problem.plans().worth_of(ascended), worth, rtol=1e-9, atol=1e-9)


def test_the_homotopy_finds_sets_that_have_to_change_together() -> None:
    """Z = 5, c = 0.22, t_max = 1: ascent from the clocked sets ends lower, the homotopy at the optimum."""
    world = paper_world(5, 0.22, 1)
    abrupt = searched(world, steps=1)
    gradual = searched(world)
    assert evaluate(world, abrupt).aihtr < 89.9 < evaluate(world, gradual).aihtr
    assert evaluate(world, gradual).aihtr == pytest.approx(89.98088602712643, abs=1e-9)


@pytest.fixture
def tree_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the tables of positions revealed late, which close the paper's worlds with no search at all."""
    monkeypatch.setattr(delayed, "WIDEST", 0)


@pytest.mark.usefixtures("tree_alone")
def test_an_open_bracket_holds_the_optimum() -> None:
    """Stopped at once, the bracket is wide but holds the value that is certified with more time."""
    world = paper_world(5, 0.22, 3)
    stopped = optimal.solve(world, nodes=1)
    assert not stopped.certified
    assert not stopped.interrupted
    certified = optimal.solve(world)
    assert (stopped.value <= certified.bound + 1e-9).all()
    assert (certified.value <= stopped.bound + 1e-9).all()
    assert stopped.lower <= certified.lower <= certified.upper <= stopped.upper


@pytest.mark.usefixtures("tree_alone")
def test_the_bracket_only_closes_while_the_search_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(optimal, "NODES_BETWEEN_REPORTS", 1)
    seen: list[SearchProgress] = []
    optimal.solve(paper_world(5, 0.22, 3), on_progress=seen.append)
    lowers, uppers = [step.lower for step in seen], [step.upper for step in seen]
    assert len(seen) >= 3
    assert lowers == sorted(lowers)
    assert uppers == sorted(uppers, reverse=True)


@pytest.mark.usefixtures("tree_alone")
def test_ctrl_c_keeps_the_bracket(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(optimal, "NODES_BETWEEN_REPORTS", 1)
    seen: list[SearchProgress] = []

    def interrupt(step: SearchProgress) -> None:
        seen.append(step)
        if len(seen) == 2:
            raise KeyboardInterrupt

    solution = optimal.solve(paper_world(5, 0.22, 3), on_progress=interrupt)
    assert solution.interrupted
    assert not solution.certified
    assert solution.lower == pytest.approx(seen[-1].lower)
    assert solution.upper == pytest.approx(seen[-1].upper)


@pytest.mark.parametrize("limit", [None, 0.0])
def test_a_search_that_ends_early_is_no_worse_than_its_start(
    limit: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = paper_world(5, 0.22, 3)
    best = optimal.solve(world)

    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    if limit is None:
        monkeypatch.setattr(optimal, "follow_credit", interrupted)
    solution = optimal.solve(world, start=best.table, time_limit=limit)
    assert solution.interrupted is (limit is None)
    assert solution.lower == pytest.approx(best.lower)
    assert solution.upper >= best.lower


@pytest.mark.parametrize("calls", [1, 66])
def test_ctrl_c_amid_an_expansion_proves_nothing_false(
    calls: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = make_world("random_support", size=4, support_size=5, cost=0.3, t_max=2, seed=1)
    best, push, pushed = optimal.solve(world), Tree._push, itertools.count()

    def cut(tree: Tree, choices: Any) -> None:
        if next(pushed) == calls:
            raise KeyboardInterrupt
        push(tree, choices)

    monkeypatch.setattr(Tree, "_push", cut)
    solution = optimal.solve(world)
    assert solution.interrupted
    assert not solution.certified
    assert (solution.bound >= best.value - 1e-9).all()


def test_the_same_world_gives_the_same_policy() -> None:
    first, second = (optimal.solve(paper_world(5, 0.22, 2)) for _ in range(2))
    np.testing.assert_array_equal(first.table.dense(), second.table.dense())
    assert first.nodes == second.nodes


def _kernel_with_edges() -> np.ndarray:
    """3x3: a row of one cell, a cell that cannot be reached, a strong asymmetry, exit 1e-6 but from one cell."""
    kernel = drift(
        3, direction=0.0, persistence=0.9, exit_probability=1e-6, border="renormalize"
    ).toarray()
    kernel[:, 4] = 0.0
    kernel[0] = 0.0
    kernel[0, 1] = 1.0 - 1e-6
    return kernel / np.maximum(kernel.sum(axis=1, keepdims=True), 1e-300) * (1.0 - 1e-6)


EDGES = {
    "free sensors": (0.0, None, 1),
    "sensors dearer than the reward": (1.5, None, 2),
    "no choice but one": (0.2, None, 0),
    "per-cell costs": (np.linspace(0.0, 0.5, 9), None, 1),
    "free safe action": (0.3, 0.0, 2),
    "safe action dear": (0.3, 1e4, 1),
}


@pytest.mark.parametrize("name", EDGES)
@pytest.mark.parametrize("shape", ["edges", "walk"])
def test_numeric_edges(name: str, shape: str) -> None:
    price, safe, t_max = EDGES[name]
    cost = np.broadcast_to(price, (9,)).astype(float)
    walk = random_walk(3, stay=0.2, diagonal=False, exit_probability=0.01, border="clip")
    kernel = _kernel_with_edges() if shape == "edges" else walk
    world = World(
        kernel, 3, cost=cost, safe_cost=float(cost.sum()) if safe is None else safe, t_max=t_max
    )
    solution = optimal.solve(world)
    scale = 1.0 + np.abs(solution.bound).max()
    assert np.isfinite(solution.value).all()
    assert np.isfinite(solution.bound).all()
    assert solution.certified
    assert (solution.value <= bounds.clocked(world) + 1e-8 * scale).all()
    assert (bounds.clocked(world) <= bounds.valid(world) + 1e-8 * scale).all()
    np.testing.assert_array_equal(solution.table.dense(), optimal.solve(world).table.dense())


@pytest.mark.parametrize("solver", ["optimal", "clocked"])
@pytest.mark.parametrize("unit", [1e-9, 1e-3, 1e3])
def test_the_unit_of_rewards_and_prices_certifies_nothing(solver: str, unit: float) -> None:
    """In thousandths all figures are a thousandth: so is a gap that counts as closed."""
    world = paper_world(4, 0.2, 1, size=5).but(detection=0.8)
    units = {"reward": unit, "cost": unit * world.cost, "safe_cost": unit * world.safe_cost}
    here, there = solve(world, solver), solve(world.but(**units), solver)
    assert there.certified == here.certified == (solver == "optimal")
    assert there.lower == pytest.approx(unit * here.lower, rel=1e-6)
    assert there.upper == pytest.approx(unit * here.upper, rel=1e-6)


def test_a_larger_grid_is_certified() -> None:
    solution = optimal.solve(paper_world(5, 0.22, 1, size=20))
    assert solution.certified
    assert solution.lower == pytest.approx(25.459964, abs=1e-5)


@pytest.mark.slow
def test_five_misses_on_a_larger_grid_are_certified() -> None:
    """Z = 5, c = .22: the clocked bound is .017 per step above, and the tree by itself left .004 of that."""
    assert optimal.solve(paper_world(5, 0.22, 5, size=20), nodes=10_000).certified


class FastClock:
    """Another machine's clock: each look at it finds an hour gone."""

    def __init__(self) -> None:
        self.hours = itertools.count()

    def __call__(self) -> float:
        return 3600.0 * next(self.hours)


def open_world() -> World:
    """25 cells of a drift that turns often, two free misses: more than 200,000 nodes to close."""
    kernel = drift(5, direction=0.0, persistence=0.5, exit_probability=0.01, border="renormalize")
    return World(kernel, 5, cost=0.3, t_max=2)


def test_the_bracket_is_the_same_at_any_speed_of_the_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    world, nodes = open_world(), 20_000
    first = optimal.solve(world, nodes=nodes)
    assert not first.certified
    assert not first.timed_out
    assert first.nodes < 2 * nodes
    monkeypatch.setattr("time.monotonic", FastClock())
    again = optimal.solve(world, nodes=nodes)
    assert np.array_equal(first.value, again.value)
    assert np.array_equal(first.bound, again.bound)
    assert first.nodes == again.nodes
    assert "another machine" not in again.ended


def test_a_time_limit_is_said_where_it_ends_the_search(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("time.monotonic", FastClock())
    solution = optimal.solve(open_world(), time_limit=1.0)
    assert solution.timed_out
    assert (
        solution.ended
        == "not closed, stopped by the time limit (another machine may end elsewhere)"
    )
    # nothing was left to stop
    assert not optimal.solve(paper_world(3, 0.16, 3), time_limit=1.0).timed_out


def test_the_solution_is_no_worse_than_the_policy_it_was_handed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    world = paper_world(5, 0.22, 2)
    best = optimal.solve(world)
    # Without the exchange, which finds the optimum of all worlds small enough to be certified in a test.
    monkeypatch.setattr(optimal, "exchanged", lambda policy, **_: policy)
    alone = optimal.solve(world, nodes=1)
    assert alone.lower < best.lower
    handed = optimal.solve(world, nodes=1, start=best.table)
    assert handed.lower == best.lower
    # A poor one changes nothing, bit for bit.
    poor = optimal.solve(world, nodes=1, start=PolicyTable.none(world))
    assert np.array_equal(poor.value, alone.value)
    assert np.array_equal(poor.bound, alone.bound)


def test_an_open_bracket_is_searched_again_from_other_starts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A better policy that they lead to is used."""
    world = open_world()
    better = optimal.solve(world, nodes=1).table
    # without exchange the first policy is worse, and stays so unless a restart is used
    monkeypatch.setattr(optimal, "exchanged", lambda policy, **_: policy)
    monkeypatch.setattr(optimal, "FIRST_NODES", 1_000)
    found: list[BoolArray] = []

    def restarted(policy: Found, others: Iterable[list[BoolArray]], **_: Any) -> Found:
        assert len(list(others)) == optimal.RESTARTS
        return Found(policy.renewal, found) if found else policy

    monkeypatch.setattr(optimal, "best_of", restarted)
    alone = optimal.solve(world, nodes=4_000)
    found = Renewal(world, world.motion).sets(better)
    solution = optimal.solve(world, nodes=4_000)
    assert solution.lower >= evaluate(world, better).aihtr > alone.lower


def test_a_start_with_as_many_keys_of_another_memory_is_left_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Nine displacements and none, or ten modes."""
    world = World(np.eye(20)[::-1] * 0.5, (1, 2), cost=0.3, modes=10, revealed=10)
    start = PolicyTable.all_on(world.task.remembering("displacement", clip=1, revealed=1))
    assert start.task.num_keys == world.num_keys
    taken = list[PolicyTable | None]()
    monkeypatch.setattr(optimal._Run, "search", lambda run: taken.append(run.start))
    optimal.solve(world, start=start)
    assert taken == [None]


def test_where_the_state_is_known_at_a_detection_memory_changes_nothing() -> None:
    """Nor does a policy of other keys to start from, whose rows are not those of cells."""
    world = paper_world(5, 0.22, 1)
    remembering = world.but(memory="displacement", clip=1)
    plain = optimal.solve(world)
    found = optimal.solve(remembering, start=PolicyTable.all_on(remembering))
    assert found.certified
    assert found.table.task.memory == "cell"
    assert np.array_equal(found.value, plain.value)
    assert np.array_equal(found.bound, plain.bound)
