"""The paper's worlds: the same as the default config describes, and as the tests' own."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.helpers import BORDERS, configured
from tests.solvers import worlds
from trackmdp.paper.worlds import COSTS, SUPPORTS, paper_kernel, paper_world
from trackmdp.world.configured import build_world
from trackmdp.world.model import World


def assert_equal(one: World, other: World) -> None:
    assert (one.size, one.reward, one.t_max) == (other.size, other.reward, other.t_max)
    assert one.safe_cost == pytest.approx(
        other.safe_cost, rel=1e-14
    )  # N² c, or all prices summed up
    assert np.array_equal(one.cost, other.cost)
    assert (one.kernel != other.kernel).nnz == 0


@pytest.mark.parametrize("border", BORDERS)
def test_the_world_of_a_draw_is_the_one_that_its_options_describe(border: Any) -> None:
    words = [
        "kernel.support_size=4",
        "kernel.seed=7",
        f"kernel.border={border}",
        "cost.sensor=0.2",
        "grid.t_max=2",
    ]
    assert_equal(
        paper_world(paper_kernel(4, 7, border), 0.2, 2), build_world(configured("train", *words))
    )


def test_the_twelve_pairs_are_those_of_the_references() -> None:
    assert {(row["support_size"], row["cost"]) for row in worlds.PAPER_REFERENCES} == {
        (support_size, cost) for support_size in SUPPORTS for cost in COSTS
    }
    for support_size in SUPPORTS:
        kernel = paper_kernel(support_size, support_size, "renormalize")
        assert_equal(
            paper_world(kernel, COSTS[0], 1), worlds.paper_world(support_size, COSTS[0], 1)
        )
