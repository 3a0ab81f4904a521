"""A tracker of several targets, step by step, and what it refuses."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import trackmdp as tm
from trackmdp.errors import UserError
from trackmdp.policies.policy import Policy
from trackmdp.solvers.several.beliefs import Beliefs, Clocks
from trackmdp.solvers.solve import solve
from trackmdp.world.group import Group
from trackmdp.world.model import World


def test_a_tracker_follows_targets_as_the_simulation_does() -> None:
    group = tm.make_world("random_walk", size=4, targets=2, exit_probability=0.1)
    found = solve(group)
    tracker = found.tracker([0, 5])
    seen = Clocks(np.array([[0, 5]]), np.zeros((1, 2), np.int64), np.ones((1, 2), dtype=bool))
    moved = Beliefs.of(group, seen.present, group.state_of(seen.located)).moved(group)
    assert tracker.sensors() == found.policy.sets(seen, moved).tolist()
    tracker.report([1, 9])
    tracker.sensors()
    with pytest.raises(UserError, match="target 0 is missed where it would have been detected"):
        tracker.report([None, 9])
    tracker.report([1, None], gone=[1])
    assert tracker.present == [True, False]
    alone = Policy.from_table(found.tables[0]).sensors(1, 0)
    assert tracker.sensors() == alone
    for cells in ([None, 3], [99, None], [1]):
        with pytest.raises(UserError, match="report"):
            tracker.report(cells)
    assert tracker.cells == [1, None]
    tracker.report(gone=[0])
    assert tracker.sensors() == []
    assert not tracker.safe


def test_a_tracker_asks_for_the_safe_action_when_a_clock_runs_out() -> None:
    world = World(np.array([[0.5, 0.4], [0.4, 0.5]]), (1, 2), cost=5.0, t_max=0, safe_cost=10.0)
    tracker = solve(Group([world] * 2)).tracker([0, 1])
    assert tracker.sensors() == []
    tracker.report()
    assert tracker.safe
    assert not tracker.sees(0)
    assert tracker.sensors() == [0, 1]
    assert tracker.sees(0)
    with pytest.raises(UserError, match="missed where it would"):
        tracker.report([None, 0])
    tracker.report([1, 0])
    assert tracker.misses == [0, 0]


@pytest.mark.parametrize(
    ("call", "given", "named"),
    [
        ("tracker", ([0, 2],), "tracker: cell=2: expected an integer from 0 to 1"),
        ("tracker", ([0.5, 1],), "tracker: cell=0.5: expected an integer"),
        ("tracker", ([None, 1],), "tracker: cell=None"),
        ("tracker", (1,), r"tracker\(1\): expected 2, one for each target"),
        ("report", (1,), r"report\(1\): expected 2, one for each target"),
        ("report", ([0.5, None],), "report: cell=0.5: expected an integer"),
        ("report", (["a", None],), "report: cell='a': expected an integer"),
        ("report", ([1, None],), "report: cell 1 is seen by none of the 1 sensors that are on"),
        ("report", ([None, None], [9]), "report: gone=9: expected an integer from 0 to 1"),
    ],
)
def test_a_tracker_of_several_refuses_what_no_sensor_reports(
    call: str, given: tuple[Any, ...], named: str
) -> None:
    """Cell 0 leads to cell 0 more often than not, where the one sensor that is on stands."""
    world = World(np.array([[0.8, 0.1], [0.1, 0.8]]), (1, 2), cost=0.3, t_max=1, safe_cost=1.0)
    solution = solve(Group([world] * 2))
    tracker = solution.tracker([0, 0])
    assert tracker.sensors() == [0]
    with pytest.raises(UserError, match=named):
        (solution.tracker if call == "tracker" else tracker.report)(*given)
    tracker.report([0, None])
    assert tracker.misses == [0, 1]
