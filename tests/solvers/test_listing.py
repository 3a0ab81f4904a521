"""Listing all plans: the best ones and their proof, for cells, footprints and revealed modes."""

from __future__ import annotations

import numpy as np
import pytest

from tests.helpers import headings
from tests.solvers.worlds import best_of_all, footprint_world
from trackmdp.arrays.types import Array, BoolArray
from trackmdp.policies.table import PolicyTable
from trackmdp.solvers.certify import listing
from trackmdp.solvers.certify.listing import best_plans
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.exchange import revealed
from trackmdp.solvers.motion_totals import forced_worth
from trackmdp.solvers.renewal import Renewal
from trackmdp.world.model import World

WORLDS = {
    "footprints": footprint_world(1),
    "other footprints": footprint_world(9),
    "footprints that miss": footprint_world(1).but(detection=0.7),
    "own sensors": World.of(footprint_world(9), footprint_world(9).kernel, coverage=None, cost=0.2),
    "modes": headings(2, t_max=1, revealed=8, safe_cost=0.5),
}


def listed(
    world: World, value: Array, slack: float = 1e-9, most: int = 10**9
) -> tuple[Array, list[BoolArray]] | None:
    """From sensing nothing, over the values `[Z]` of a detection."""
    renewal, left = Renewal(world, world.motion), most
    none = [np.zeros((len(choice.rows), 1), dtype=bool) for choice in renewal.choices]
    detected = world.reward + value
    one_more = revealed(world, detected, forced_worth(world, detected), 1)

    def go_on(plans: int) -> bool:
        nonlocal left
        left -= plans
        return left >= 0

    return best_plans(renewal.problem(value), none, slack, one_more[renewal.free[-2].states], go_on)


@pytest.mark.parametrize("name", WORLDS)
def test_over_the_optimum_the_plans_found_are_its_own(name: str) -> None:
    world = WORLDS[name]
    best = best_of_all(world)
    found = listed(world, best)
    assert found is not None
    most, sets = found
    assert most == pytest.approx(best, abs=1e-7)
    table = Renewal(world, world.motion).table(sets)
    assert evaluate(world, table).starts == pytest.approx(best, abs=1e-7)


@pytest.mark.parametrize("name", WORLDS)
def test_over_a_poor_policy_no_plan_is_worth_more_than_proved(name: str) -> None:
    """One step of policy iteration from sensing nothing: worth what is proved, and more than before."""
    world = WORLDS[name]
    value = evaluate(world, PolicyTable.none(world)).starts
    found = listed(world, value)
    assert found is not None
    most, sets = found
    worth = Renewal(world, world.motion).problem(value).worth_of(sets)
    assert worth == pytest.approx(most, abs=1e-8)
    assert (worth >= value - 1e-9).all()
    assert worth.sum() > value.sum() + 1e-3


def test_a_list_that_is_too_long_or_stopped_gives_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    world = WORLDS["own sensors"]
    value = evaluate(world, PolicyTable.none(world)).starts
    assert listed(world, value, most=3) is None
    monkeypatch.setattr(listing, "_MOST_BITS", 1)
    assert listed(world, value) is None
