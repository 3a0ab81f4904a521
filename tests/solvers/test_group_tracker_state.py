"""A tracker of several targets by positions, and its state."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

import trackmdp as tm
from trackmdp.errors import UserError

GROUP = tm.make_world(
    "random_walk", size=4, targets=2, detection=0.8, cost=0.05, t_max=1, cell=10, origin=(0, 0)
)
"""Cells of 10, row 3 at the bottom: (5, 5) is in cell 12."""
FOUND = tm.solve(GROUP)


def begun() -> tm.GroupTracker:
    return FOUND.tracker(at=[(5, 5), (25, 35)])


def stepped(tracker: tm.GroupTracker) -> list[Any]:
    """All that a step shows of it."""
    on = tracker.sensors()
    return [on, tracker.positions(), [tracker.sees(cell) for cell in range(16)], tracker.safe]


def test_a_tracker_of_two_goes_on_from_its_state() -> None:
    tracker = begun()
    assert repr(tracker) == "GroupTracker(cells=[12, 2], misses=[0, 0], safe=False)"
    assert not tracker.sees(12)
    reports: list[dict[str, Any]] = [
        {"at": [None, (25, 25)]},
        {"at": [None, None]},
        {"at": [(15, 15), (25, 25)]},
        {"at": [(15, 5), None], "gone": [1]},
        {},
    ]
    places = [GROUP.task.place_of(cell) for cell in range(16)]
    for report in reports:
        on, positions, seen, _ = stepped(tracker)
        assert positions == [places[cell] for cell in on]
        assert on == np.flatnonzero(seen).tolist()
        again = tm.GroupTracker.restore(FOUND.policy, json.loads(json.dumps(tracker.state())))
        for each in (tracker, again):
            each.report(**report)
        assert stepped(again) == stepped(tracker)
        assert again.state() == tracker.state()
        np.testing.assert_array_equal(again.belief(), tracker.belief())
        tracker = again
    assert repr(tracker) == "GroupTracker(cells=[13, None], misses=[1, 0], safe=False)"
    assert tracker.belief().sum(axis=1) == pytest.approx([1, 0])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cells": [16, 0]}, "state: cell=16: expected an integer from 0 to 15"),
        ({"cells": [1]}, "state: cells([1]): expected 2, one for each target"),
        ({"misses": [0, 3]}, "state: misses=3: expected an integer from 0 to 2"),
        ({"present": [1, 0]}, "state: expected True or False as present"),
        ({"on": [16]}, "state: on=16: expected an integer from 0 to 15"),
        (
            {"on": [0], "misses": [0, 2]},
            "state: on=[0]: expected all sensors, the safe action is due",
        ),
        (
            {"belief": [[0.5] + [0.0] * 15, None]},
            "state: belief, expected 16 probabilities that sum",
        ),
        ({"belief": [[1.0], None]}, "state: belief, expected 16 probabilities"),
        ({"task": {}}, "state: made for {}, expected {'size': "),
        (
            {"more": 1},
            "state: expected a dict with belief, cells, history, key, misses, on, present, task",
        ),
    ],
)
def test_a_state_that_does_not_fit_is_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError) as caught:
        tm.GroupTracker.restore(FOUND.policy, begun().state() | change)
    assert str(caught.value).startswith(message)
    three = tm.solve(tm.Group([GROUP.kinds[0]] * 3)).policy
    with pytest.raises(UserError, match=r"^state: made for .*'targets': \[0, 0\]}, expected "):
        tm.GroupTracker.restore(three, begun().state())


def test_a_state_of_other_footprints_is_refused() -> None:
    world = tm.make_world("random_walk", size=2, cost=0.05)
    covers = ([[1, 1, 0, 0], [0, 0, 1, 1]], [[1, 0, 1, 0], [0, 1, 0, 1]])
    mine, other = (world.but(coverage=each, cost=0.1) for each in covers)
    with pytest.raises(UserError, match=r"^state: made for .*'footprints'"):
        tm.Tracker.restore(tm.Policy.none(other), tm.Policy.none(mine).tracker(0).state())
    one, another = (tm.solve(tm.Group([each] * 2)) for each in (mine, other))
    with pytest.raises(UserError, match=r"^state: made for .*'footprints'"):
        tm.GroupTracker.restore(another.policy, one.tracker([0, 1]).state())


def test_a_target_where_the_motion_of_another_policy_has_none_gains_nothing() -> None:
    """Two motions on a line, to the right and to the left; a belief of the first one is taken up by the second."""
    step = np.diag([0.5] * 3)
    right, left = (step + np.diag([0.3, 0.3], side) for side in (1, -1))
    mine, other = (
        tm.solve(tm.Group([tm.World(kernel, (1, 3), cost=0.01, t_max=2)])).policy
        for kernel in (right, left)
    )
    state = tm.GroupTracker(mine, [1]).state() | {"misses": [1], "belief": [[0.0, 0.0, 1.0]]}
    assert tm.GroupTracker.restore(mine, state).sensors() == [2]
    assert tm.GroupTracker.restore(other, state).sensors() == [1]


def test_mistakes_with_positions_and_policies_end_in_one_line() -> None:
    tracker = begun()
    with pytest.raises(UserError, match=r"^report: no sensors\(\) since the last report"):
        tracker.report()
    tracker.sensors()
    before = tracker.state()
    for mistake, message in (
        (lambda: FOUND.tracker([0, 1], at=[(5, 5), (5, 5)]), "tracker: cell=0 and at=(5, 5), exp"),
        (lambda: FOUND.tracker(at=[(5, 5), (5, 50)]), "cell_of: x, y = 5, 50 is outside of the gr"),
        (lambda: FOUND.tracker(at=[(5, 5)]), "tracker([(5, 5)]): expected 2, one for each target"),
        (lambda: FOUND.tracker(), "tracker: cell=None: expected an integer from 0 to 15"),
        (
            lambda: tracker.report(at=[(5, 5, 5), None]),
            "report: at=(5, 5, 5), expected two numbers",
        ),
        (lambda: tracker.report(at=[None, (35, 5)]), "report: cell 15 is seen by none of the"),
        (lambda: tm.GroupTracker(FOUND, [0, 1]), "tracker: a GroupSolution, expected a policy of"),
    ):
        with pytest.raises(UserError) as caught:
            mistake()
        assert str(caught.value).startswith(message)
    assert tracker.state() == before
