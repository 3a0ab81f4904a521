"""The frontier of accuracy against sensors: concave, certified, the same as that of all policies of tiny worlds."""

from __future__ import annotations

import itertools
import sys
from dataclasses import replace
from functools import cache
from types import FrameType
from typing import Any

import numpy as np
import pytest

import trackmdp as tm
from tests.helpers import later
from tests.solvers.worlds import all_plans
from trackmdp.arrays.types import Array
from trackmdp.errors import UserError
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.frontier import FrontierProgress, _Trace, frontier
from trackmdp.solvers.solve import run_solver
from trackmdp.solvers.tradeoff import Tradeoff
from trackmdp.world.model import World


@cache
def small(safe_cost: float | None) -> World:
    world = tm.make_world(size=4, safe_cost=safe_cost)
    assert isinstance(world, World)
    return world


@cache
def found(safe_cost: float | None) -> Tradeoff:
    return frontier(small(safe_cost))


def tiny(seed: int, t_max: int, **options: Any) -> World:
    """Three cells in a row, a safe action of any price; 64 plans from each cell at most."""
    rng = np.random.default_rng(seed)
    kernel = rng.random((3, 3)) ** rng.choice([1.0, 3.0])
    kernel *= 0.9 / kernel.sum(axis=1, keepdims=True)
    given: dict[str, Any] = {"cost": 0.3, "safe_cost": float(rng.choice([0.0, 0.2, 1.0, 5.0]))}
    return World(kernel, (1, 3), t_max=t_max, reward=2.0, **(given | options))


def all_policies(world: World) -> Array:
    """`[P, 2]` sensors per step, each with its price over the mean one, and net of every deterministic policy."""
    nothing = replace(world, cost=0.0, safe_cost=0.0, reward=0.0)
    rewards = [
        replace(nothing, reward=1.0, safe_cost=world.safe_cost / world.reward),
        replace(nothing, cost=world.cost / world.cost.mean()),
    ]
    plans = [[all_plans(each, x) for each in rewards] for x in range(world.num_cells)]
    places = list(itertools.product(*(range(len(each[0][0])) for each in plans)))
    pick = np.array(places).T
    located = np.stack([each[0][1][row] for each, row in zip(plans, pick, strict=True)], axis=1)
    totals = np.stack(
        [
            np.stack([part[0] for part in each], 1)[row]
            for each, row in zip(plans, pick, strict=True)
        ],
        axis=1,
    )
    per_episode = np.linalg.solve(np.eye(world.num_cells) - located, totals).mean(axis=1)
    kernel = world.kernel.toarray()
    steps = np.linalg.solve(np.eye(len(kernel)) - kernel, kernel.sum(axis=1)).mean()
    return np.stack([-per_episode[:, 1], per_episode[:, 0]], axis=1) / steps


def hull_of(points: Array) -> Array:
    """`[C, 2]` corners of the concave hull from the least sensors up to the greatest net, by gift wrapping."""
    least = points[np.isclose(points[:, 0], points[:, 0].min(), rtol=0, atol=1e-12)]
    corners = [least[least[:, 1].argmax()]]
    while True:
        away = points - corners[-1]
        away = away[(away[:, 0] > 1e-9) & (away[:, 1] > 1e-12)]
        if not len(away):
            return np.array(corners)
        slopes = away[:, 1] / away[:, 0]
        steepest = away[slopes >= slopes.max() - 1e-9]
        corners.append(corners[-1] + steepest[steepest[:, 0].argmax()])


WORLDS = {
    "t_max 1": tiny(0, 1),
    "t_max 0": tiny(1, 0),
    "D = 0": tiny(2, 1, safe_cost=0.0),
    "D dear": tiny(3, 1, safe_cost=9.0),
    "misses": tiny(5, 1, detection=[0.9, 0.7, 0.8]),
    "a safe action that misses": tiny(6, 0, detection=0.9, safe_detection=0.8),
    "prices": tiny(7, 1, cost=[0.1, 0.2, 0.4]),
    "a free sensor": tiny(8, 1, cost=[0.0, 0.2, 0.4]),
}
PLAIN = ("t_max 1", "D dear")


@pytest.mark.parametrize("name", [*(name for name in WORLDS if name not in PLAIN), *later(PLAIN)])
def test_corners_are_those_of_all_policies(name: str) -> None:
    world = WORLDS[name]
    made, points = frontier(world, resolution=1e-8, tolerance=1e-10), all_policies(world)
    corners = np.array([(each.sensors, each.net) for each in made.corners])
    np.testing.assert_allclose(corners, hull_of(points), rtol=0, atol=1e-7)
    assert len(corners) >= 3
    assert made.certified
    # Of policies with as many sensors the one of the greatest net.
    most = points[np.lexsort((-points[:, 1], points[:, 0].round(4)))]
    most = most[np.unique(most[:, 0].round(4), return_index=True)[1]]
    bounds = [made.bound(sensors) for sensors in most[:, 0]]
    assert (most[:, 1] <= np.array(bounds) + 1e-8).all()


@pytest.mark.parametrize("safe_cost", [None, 0.0])
def test_the_frontier_is_concave_and_certified(safe_cost: float | None) -> None:
    made = found(safe_cost)
    corners = made.corners
    figures = np.array([(each.sensors, each.net, -each.price) for each in corners])
    assert (np.diff(figures, axis=0) > 0).all()
    slopes = np.diff(figures[:, 1]) / np.diff(figures[:, 0])
    assert (np.diff(slopes) < 0).all()
    assert made.certified
    assert all(each.certified for each in corners)
    assert made.gap <= 1e-3
    # A corner's price lies between the slopes of its edges.
    prices = figures[1:-1, 2]
    assert (-prices <= slopes[:-1] + 1e-6).all()
    assert (-prices >= slopes[1:] - 1e-6).all()
    assert corners[0].sensors == 0.0
    assert corners[-1].accuracy == pytest.approx(1.0)


@pytest.mark.parametrize("safe_cost", [None, 0.0])
def test_a_corner_is_the_best_policy_of_its_price(safe_cost: float | None) -> None:
    """Figures of a policy per episode and per step go together, and agree with a solve at that price."""
    world, made = small(safe_cost), found(safe_cost)
    for corner in made.corners:
        priced = replace(world, cost=corner.price)
        best = tm.solve(priced)
        assert corner.lower == pytest.approx(best.lower, abs=1e-4)
        figures = evaluate(priced, corner.table)
        assert figures.aihtr == pytest.approx(corner.lower, abs=1e-9)
        assert figures.sensors_per_step == corner.sensors
        assert made.steps * (corner.net - corner.price * corner.sensors) == pytest.approx(
            figures.aihtr, abs=1e-9
        )
    if safe_cost == 0:
        assert all(corner.net == corner.accuracy for corner in made.corners)


def test_a_finer_frontier_is_no_higher_than_the_gap_of_a_coarse_one() -> None:
    coarse, fine = frontier(small(None), resolution=0.05), found(None)
    assert len(coarse.corners) < len(fine.corners)
    assert 1e-3 < coarse.gap <= 0.05
    for corner in fine.corners:
        mixed = coarse.at(sensors=corner.sensors)
        assert mixed.net - 1e-9 <= corner.net <= mixed.net + coarse.gap + 1e-6
        assert corner.net <= coarse.bound(corner.sensors) + 1e-6


def test_a_simulated_corner_has_its_place() -> None:
    made = found(None)
    for corner in (made.at(accuracy=0.95).parts[0][1], made.corners[1]):
        simulated = tm.simulate(small(None), corner.policy, 300, seed=1).figures()
        for name, exact in (("accuracy", corner.accuracy), ("sensors_per_step", corner.sensors)):
            estimate = getattr(simulated, name)
            assert 0 < estimate.standard_error < 0.03
            assert abs(estimate.mean - exact) <= 3 * estimate.standard_error


def test_a_mixture_has_what_was_asked_for() -> None:
    made = found(None)
    mixed = made.at(accuracy=0.95)
    assert mixed.accuracy == pytest.approx(0.95, abs=1e-12)
    (_, above), (_, below) = mixed.parts
    assert below.accuracy < 0.95 <= above.accuracy
    assert made.corners.index(above) == made.corners.index(below) + 1
    assert sum(weight for weight, _ in mixed.parts) == pytest.approx(1.0)
    spent = made.at(sensors=0.7)
    assert spent.sensors == pytest.approx(0.7, abs=1e-12)
    assert spent.net <= made.bound(0.7) <= spent.net + made.gap + 1e-9
    assert made.at(sensors=spent.sensors).accuracy == pytest.approx(spent.accuracy)


def test_what_a_corner_has_is_that_corner_alone() -> None:
    made = found(None)
    assert made.at(sensors=0.0).parts == [(1.0, made.corners[0])]
    assert made.at(accuracy=0.1).parts == [(1.0, made.corners[0])]
    assert made.at(accuracy=1.0).accuracy == pytest.approx(1.0)
    assert made.at(sensors=16.0).parts == [(1.0, made.corners[-1])]
    assert made.at(sensors=made.corners[2].sensors).parts[0] == (1.0, made.corners[2])


@pytest.mark.parametrize(
    ("asked", "named"),
    [
        ({}, "got 0"),
        ({"accuracy": 0.9, "sensors": 1.0}, "got 2"),
        ({"accuracy": 1.5}, "accuracy=1.5: expected a number from 0 to 1"),
        ({"accuracy": -0.1}, "accuracy=-0.1"),
        ({"accuracy": float("nan")}, "accuracy=nan"),
        ({"sensors": -1.0}, "sensors=-1.0: expected a number from 0"),
    ],
)
def test_what_no_mixture_has_is_refused(asked: dict[str, float], named: str) -> None:
    with pytest.raises(UserError, match=named):
        found(None).at(**asked)


@pytest.mark.usefixtures("little_search")
def test_where_the_bracket_stays_open_the_bound_is_above() -> None:
    world = tm.make_world("heading", size=3)
    made = frontier(world, resolution=0.02)
    assert not made.certified
    assert made.gap > made.resolution
    inner = made.corners[len(made.corners) // 2]
    assert not inner.certified
    assert inner.lower < inner.upper
    assert made.bound(inner.sensors) > inner.net + 1e-3
    assert made.corners[-1].accuracy == pytest.approx(1.0)


def test_policies_of_another_solver_lie_below_the_frontier() -> None:
    made, best = frontier(small(0.0), "qmdp"), found(0.0)
    assert not made.certified
    for corner in made.corners:
        assert corner.net <= best.bound(corner.sensors) + 1e-6
        assert corner.net <= made.bound(corner.sensors) + 1e-6


def test_sensors_that_cover_several_cells_have_a_frontier() -> None:
    coverage = np.array([[1, 1, 0, 0], [0, 0, 1, 1], [1, 0, 1, 0], [0, 0, 0, 1]], dtype=bool)
    kernel = np.full((4, 4), 0.24)
    world = World(kernel, 2, cost=[0.1, 0.1, 0.2, 0.05], t_max=1, coverage=coverage)
    made = frontier(world)
    assert made.certified
    assert made.corners[-1].accuracy == pytest.approx(1.0)
    # Two sensors of mean price cover all cells; the third covers them again.
    assert made.corners[-1].sensors == pytest.approx(0.2 / np.mean(world.cost))


def test_ctrl_c_leaves_the_corners_found_so_far() -> None:
    seen: list[FrontierProgress] = []

    def stop(progress: FrontierProgress) -> None:
        seen.append(progress)
        if len(seen) == 3:
            raise KeyboardInterrupt

    made = frontier(small(None), on_progress=stop)
    assert made.interrupted
    assert not made.certified
    assert seen[-1].corners == len(made.corners)
    assert made.gap >= seen[-1].left > made.resolution
    assert made.at(sensors=0.5).sensors == pytest.approx(0.5)


def test_prices_far_apart_are_raised_as_far_as_prices_go() -> None:
    """Two sensors stay on at the highest price of the third: what is left out is not certified."""
    world = World(np.full((3, 3), 0.3), (1, 3), cost=[1e9, 0.1, 0.1], t_max=0)
    made = frontier(world)
    assert made.corners[0].sensors > 0
    assert not made.certified


@pytest.mark.parametrize("prices", [1, 2])
def test_ctrl_c_before_the_highest_price_certifies_nothing(
    prices: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing is known of fewer sensors than those of the only corner."""

    def run(*args: Any, **kwargs: Any) -> Any:
        if next(solved) == prices:
            raise KeyboardInterrupt
        return run_solver(*args, **kwargs)

    solved = itertools.count()
    monkeypatch.setattr("trackmdp.solvers.frontier.run_solver", run)
    made = frontier(small(None))
    assert made.interrupted
    assert made.corners[0].sensors > 0
    assert not made.certified


def test_ctrl_c_at_any_line_keeps_each_price_with_its_bound() -> None:
    """In the third solve, line by line."""
    code, passed = _Trace.solve.__code__, itertools.count()

    def traced(frame: FrameType, event: str, _: object) -> Any:
        if event == "call":
            return traced if frame.f_code is code and next(calls) == 2 else None
        if event == "line" and next(lines) == line:
            raise KeyboardInterrupt
        return traced

    for line in passed:  # noqa: B007 (read by `traced`)
        calls, lines, before = itertools.count(), itertools.count(), sys.gettrace()
        sys.settrace(traced)
        try:
            made = frontier(small(None))
        finally:
            sys.settrace(before)
        if not made.interrupted:
            break
        assert len(made.slopes) == len(made.bounds) >= 2
    assert line > 10


@pytest.mark.parametrize(
    ("world", "options", "named"),
    [
        (small(None), {"resolution": 0.0}, "resolution=0: expected"),
        (small(None), {"solver": "qmpd"}, "solver=qmpd: expected one of"),
        (small(None), {"nodes": 0}, "solver.nodes=0: expected"),
        (small(None), {"near": -1.0}, "near=-1.0: expected"),
        (small(None), {"near": float("nan")}, "near=nan: expected"),
        (small(None), {"near": "2"}, "near=2: expected"),
        (small(None), {"depht": 3}, "solver.depht: unknown option"),
        (replace(small(None), max_steps=9), {}, "max_steps=9: .* expected null"),
        (replace(small(None), reward=0.0), {}, "reward=0: expected"),
        (World(np.zeros((4, 4)), 2, cost=0.1, t_max=0), {}, "kernel: the target leaves"),
        ("world", {}, "first argument is a str"),
    ],
)
def test_what_has_no_frontier_is_refused(world: Any, options: dict[str, Any], named: str) -> None:
    with pytest.raises(UserError, match=named) as refused:
        frontier(world, **options)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("last", [0.16, 0.3])
def test_cells_without_a_sensor_have_none_at_any_price(last: float) -> None:
    prices = np.full((3, 3), 0.16)
    prices[:, 0], prices[2, 2] = np.nan, last
    world = tm.make_world("random_walk", size=3, cost=prices, safe_cost=1.0)
    found = frontier(world)
    assert found.equal_prices == (last == 0.16)
    assert max(corner.sensors for corner in found.corners) > 0
    for corner in found.corners:
        assert not corner.table.dense()[..., [0, 3, 6]].any()
    cost = found.corners[1].price * prices / np.nanmean(prices)
    best = tm.solve(tm.make_world("random_walk", size=3, cost=cost, safe_cost=1.0))
    assert found.corners[1].lower == pytest.approx(best.lower)
