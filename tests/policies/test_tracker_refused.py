"""A tracker refuses mistakes in one line, and stays as it was."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import trackmdp as tm
from tests.episodes.logs import WORLD
from tests.helpers import small_world
from tests.policies.test_tracker import WORLDS, begun, some
from trackmdp.errors import UserError
from trackmdp.policies.policy import Policy

MISTAKES: dict[str, tuple[Any, str]] = {
    "second report": (lambda t: (t.report(0), t.report(0)), r"report: no sensors\(\) since"),
    "outside": (lambda t: t.report(9), "report: cell=9: expected an integer from 0 to 8"),
    "text": (lambda t: t.report("5"), "report: cell='5': expected an integer from 0 to 8"),
    "seen outside": (lambda t: t.sees(9), "sees: cell=9: expected an integer from 0 to 8"),
    "no cell": (lambda t: t.report(False), "report: cell=False: expected"),
    "fraction": (lambda t: t.report(0.5), "report: cell=0.5: expected"),
    "off": (lambda t: t.report(5), "report: cell 5 is seen by none of the 2 sensors that are on"),
    "mode": (lambda t: t.report(4, mode=1), "report: mode=1, expected none"),
    "mode of nothing": (lambda t: t.report(None, mode=1), "report: mode=1 without a cell"),
    "exited": (lambda t: (t.exited(), t.sensors()), r"sensors\(\): the target has exited"),
    "exited twice": (lambda t: (t.exited(), t.exited()), r"exited\(\): the target has exited"),
    "after the exit": (lambda t: (t.exited(), t.report(0)), "report: the target has exited"),
    "start": (lambda _: begun(mode=1), "tracker: mode=1, expected none"),
    "seed": (lambda _: begun(seed=-1), "tracker: seed=-1: expected an integer >= 0"),
    "file": (lambda _: tm.Tracker("a/sets.json", 0), "tracker: a/sets.json: expected a policy.npz"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes_end_in_one_line(name: str) -> None:
    mistake, message = MISTAKES[name]
    with pytest.raises(UserError, match=f"^{message}") as caught:
        mistake(begun())
    assert "\n" not in str(caught.value)


def test_a_refused_report_changes_nothing() -> None:
    tracker = begun()
    before = tracker.state()
    with pytest.raises(UserError):
        tracker.report(5)
    assert tracker.state() == before
    tracker.report(4)


def test_modes_are_asked_for_where_detections_give_them() -> None:
    policy = some(WORLDS["mode"])
    with pytest.raises(UserError, match=r"^tracker: mode=None, expected one of 0 \.\.\. 7$"):
        policy.tracker(0)
    with pytest.raises(UserError, match=r"^tracker: mode=8: expected an integer from 0 to 7"):
        policy.tracker(0, mode=8)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"key": 99}, "state: key=99: expected an integer from 0 to 8"),
        ({"misses": 3}, "state: misses=3: expected an integer from 0 to 2"),
        ({"misses": None}, "state: misses=None: expected"),
        ({"on": [9]}, "state: on=9: expected an integer from 0 to 8"),
        ({"on": [0, 0]}, "state: on=[0, 0]: expected sensors that can be on, in order"),
        ({"on": 3}, "state: expected a list or None as on"),
        ({"exited": 1}, "state: expected True or False as exited"),
        ({"task": {}}, "state: made for {}, expected {'size': "),
        (
            {"more": 1},
            "state: expected a dict with belief, exited, key, misses, on, seed, steps, task",
        ),
    ],
)
def test_a_state_that_does_not_fit_is_refused(change: dict[str, Any], message: str) -> None:
    policy = Policy.all_on(small_world())
    state = policy.tracker(4).state()
    with pytest.raises(UserError) as caught:
        tm.Tracker.restore(policy, state | change)
    assert str(caught.value).startswith(message)
    with pytest.raises(UserError, match=r"^state: expected a dict"):
        tm.Tracker.restore(policy, 5)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("change", "wanted"),
    [
        ({"on": [3, 4, 5]}, "on=[3, 4, 5]: expected at most 2 sensors that can be on, in order"),
        ({"misses": 2, "on": [4]}, "on=[4]: expected all sensors, the safe action is due"),
        ({"belief": [0.0] * 8 + [0.5]}, "belief, expected 9 probabilities that sum to 1"),
        ({"belief": [1.0] + [1e-3] * 8}, "belief, expected 9 probabilities that sum to 1"),
    ],
)
def test_a_state_that_no_tracker_has_is_refused(change: dict[str, Any], wanted: str) -> None:
    world = small_world().but(budget=2)
    policy = Policy.none(world)
    tracker = policy.tracker(4, world=world)
    tracker.sensors()
    state = tracker.state()
    assert tm.Tracker.restore(policy, state | {"on": [3, 4]}, world).sensors() == [3, 4]
    due = tm.Tracker.restore(policy, state | {"misses": 2, "on": list(range(9))}, world)
    assert due.safe
    with pytest.raises(UserError) as caught:
        tm.Tracker.restore(policy, state | change, world)
    assert str(caught.value) == f"state: {wanted}"


def test_a_state_of_another_memory_is_refused() -> None:
    state = some(WORLDS["gaps"]).tracker(3).state()
    with pytest.raises(
        UserError, match=r"^state: made for .*displacement_gap.*, expected .*'cell'"
    ):
        tm.Tracker.restore(some(WORLD), state)


def test_sets_beyond_the_budget_are_neither_followed_nor_handed_on(tmp_path: Path) -> None:
    """All 9 sensors on where 2 may be; a tracker of the file is refused as well, and nothing is written."""
    policy = Policy.all_on(small_world().but(budget=2))
    policy.save(tmp_path / "policy.npz")
    calls: list[Callable[[], Any]] = [
        lambda: policy.tracker(4),
        lambda: tm.Tracker(tmp_path / "policy.npz", 4),
        lambda: tm.Tracker.restore(policy, begun().state()),
        lambda: tm.export(policy, tmp_path / "sets.json"),
    ]
    for call in calls:
        with pytest.raises(UserError, match=r"^policy: up to 9 sensors on in a step; expected 2$"):
            call()
    assert [each.name for each in tmp_path.iterdir()] == ["policy.npz"]


def test_the_motion_of_a_group_is_refused() -> None:
    with pytest.raises(UserError, match=r"^tracker: world: expected a World of 3 x 3 cells"):
        begun(world=tm.Group([small_world()] * 2))


def test_episodes_are_no_policy_although_they_hold_sensors() -> None:
    played: Any = tm.simulate(small_world(), "none", 2)
    with pytest.raises(UserError, match=r"^tracker: a Episodes, expected a policy of one target"):
        tm.Tracker(played, 3)
