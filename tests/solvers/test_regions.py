"""Large grids, region by region: the same policies and proofs as of the whole grid at once, in bounded memory."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings

import trackmdp as tm
from tests.solvers.worlds import best_of_all, tiny_worlds
from trackmdp.errors import UserError
from trackmdp.solvers import optimal, regions, rules
from trackmdp.solvers.certify.inner import InnerProblem
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.exchange import exchange
from trackmdp.solvers.renewal import Renewal
from trackmdp.solvers.solution import SearchProgress, Solution
from trackmdp.solvers.value import value_of
from trackmdp.world.make import make_world
from trackmdp.world.model import World


def by_regions(
    world: World, side: int, monkeypatch: pytest.MonkeyPatch, **options: object
) -> Solution:
    with monkeypatch.context() as patch:
        patch.setattr(optimal, "region_side", lambda *_: side)
        return optimal.solve(world, **options)  # type: ignore[arg-type]


@settings(max_examples=25)
@given(tiny_worlds(size=2, most_t_max=2, support=2))
def test_every_chain_of_tiny_worlds_tried(world: World) -> None:
    with pytest.MonkeyPatch.context() as patch:
        solution = by_regions(world, 1, patch, tolerance=1e-9)
    best = best_of_all(world)
    scale = 1.0 + np.abs(best).max()
    assert (best <= solution.bound + 1e-8 * scale).all()
    assert solution.certified
    np.testing.assert_allclose(solution.value, best, rtol=0, atol=2e-9 * scale)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"t_max": 2},
        {"window": 1, "cost": 0.2, "safe_cost": 4.0},
        {"p_d": 0.95, "cost": 0.2, "safe_cost": 4.0},
    ],
    ids=["t_max 1", "t_max 2", "window", "misses"],
)
def test_regions_end_where_the_whole_grid_does(
    options: dict, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = _world(10, **options)
    whole = optimal.solve(world)
    assert (
        float(evaluate(world, rules.clocked_policy(world)).aihtr) < whole.lower - 1e-3
    )  # there is something to search
    found = by_regions(world, 5, monkeypatch)
    assert whole.certified and found.certified
    assert found.lower == pytest.approx(whole.lower, rel=2e-6)
    assert found.upper == pytest.approx(whole.upper, rel=2e-6)


def test_a_round_is_the_round_of_the_whole_grid_whatever_the_side() -> None:
    world = _world(11)
    policy = rules.clocked_policy(world)
    value = evaluate(world, policy).value
    renewal = Renewal(world, world.motion)
    plans = InnerProblem.of(renewal, value).plans()
    sets = plans.ascend(renewal.sets(policy), sweeps=10)
    whole = renewal.table(exchange(plans, sets, np.ones(world.num_cells, dtype=bool))).dense()
    for side in (3, 4, 11):
        found = regions.improved(world, policy, value, side, lambda _: True)
        np.testing.assert_array_equal(found.dense(), whole)


def test_what_is_proved_of_a_plan_holds_for_each_cell() -> None:
    world = _world(8)
    policy = rules.clocked_policy(world)
    value = evaluate(world, policy).value
    short, better = regions.proved(
        world, policy, value, 3, 1e-9, lambda _, __, tree: tree.run(lambda _: True)
    )
    # One step of policy iteration gains no more than is proved, at no cell, and closes it where trees are closed.
    renewal = Renewal(world, world.motion)
    gained = InnerProblem.of(renewal, value).plans().worth_of(renewal.sets(better)) - value
    assert short.max() > 1e-3
    np.testing.assert_allclose(gained, short, rtol=0, atol=1e-7)


def test_a_stopped_proof_still_bounds(monkeypatch: pytest.MonkeyPatch) -> None:
    world = _world(12, t_max=2)
    best = optimal.solve(world)
    found = by_regions(world, 6, monkeypatch, nodes=50)
    assert not found.certified
    assert found.upper >= best.lower - 1e-9
    assert found.lower <= best.upper + 1e-9


def test_progress_says_how_long_a_round_will_take(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[SearchProgress] = []
    by_regions(_world(12), 4, monkeypatch, on_progress=seen.append)
    stages = [step.stage for step in seen if step.left is not None]
    # nine regions; the last of a round has nothing left
    assert stages[:9] == ["policy iteration"] * 9
    assert "branch and bound" in stages
    assert [step.left for step in seen if step.left is not None][8] == 0


def test_memory_decides_on_the_side_of_a_region() -> None:
    small = _world(12)
    assert regions.region_side(small) is None
    large = make_world("random_support", size=150, support_size=5, radius=2)
    side = regions.region_side(large)
    assert side == regions.LARGEST_SIDE == regions.region_side(large, "64GiB")
    narrow = regions.region_side(large, "125MiB")
    assert narrow is not None and 1 <= narrow < side
    # the sizes add up: what all of it takes is below the limit
    assert regions._whole_bytes(large) + regions._region_bytes(large, narrow) <= 125 * 2**20
    with pytest.raises(
        UserError, match=r"solver.memory=80MiB: 150 x 150 cells need about 0\.\d\d GiB, expected at"
    ):
        regions.region_side(large, "80MiB")


def test_memory_grows_with_what_is_left_unsensed() -> None:
    """At T_max 3 the clocked plans of 160 x 160 cells took 112 MB at c = .16, and 500 MB at c = .22."""
    costs = {0.16: (95, 190), 0.22: (450, 650)}
    for cost, (least, most) in costs.items():
        world = make_world(
            "random_support",
            size=160,
            support_size=5,
            radius=2,
            cost=cost,
            t_max=3,
            safe_cost=100 * cost,
        )
        assert least <= regions._whole_bytes(world) / 2**20 <= most


def test_what_the_machine_lacks_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(regions, "free_bytes", lambda: 2**25)
    with pytest.raises(
        UserError, match=r"solver.memory=null: .* need about .* 0\.03 GiB are available"
    ):
        regions.region_side(_world(12))


def test_a_size_that_is_none_is_refused() -> None:
    with pytest.raises(
        UserError, match=r"solver.memory=2GB: expected bytes, or a size such as 500MiB or 2GiB"
    ):
        tm.solve(_world(4), memory="2GB")


def _world(size: int, **options: Any) -> World:
    """Five successors of which the last is not worth a sensor: clocked plans are not the best ones."""
    p_d = options.pop("p_d", 1.0)
    world = make_world(
        "random_support",
        size=size,
        support_size=5,
        radius=2,
        **{"cost": 0.22, "safe_cost": 22.0, **options},
    )
    return replace(world, detection=np.full(world.num_cells, p_d))


@pytest.mark.parametrize("t_max", [1, 2])
def test_plans_without_proof_are_made_by_regions_on_large_grids(
    t_max: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And with a budget, for which there are no regions, on the whole."""
    world = make_world("drift", size=12, cost=0.3, t_max=t_max)
    whole = value_of(world, optimal.plan_without_proof(world, 0))
    monkeypatch.setattr(optimal, "DIRECT_CELLS", 100)
    seen = list[World]()

    def side(world: World) -> int:
        seen.append(world)
        return 5

    monkeypatch.setattr(optimal, "widest_side", side)
    found = value_of(world, optimal.plan_without_proof(world, 0))
    assert found.aihtr > value_of(world, rules.clocked_policy(world)).aihtr + 0.01
    assert found.aihtr == pytest.approx(whole.aihtr, abs=0.01)
    optimal.plan_without_proof(world.but(budget=2), 0)
    assert seen == [world]
