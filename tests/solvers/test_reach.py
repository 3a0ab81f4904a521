"""One policy after another along the same tracks: each is worth what it is worth by itself."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import sparse

from tests.helpers import small_world
from tests.tracks import drawn, recorded
from trackmdp.policies.table import PolicyTable
from trackmdp.solvers import reach
from trackmdp.solvers.reach import Reach, Replays
from trackmdp.solvers.value import value_of
from trackmdp.solvers.walk import all_events

KINDS: dict[str, dict[str, Any]] = {
    "displacement": {"memory": "displacement"},
    "gap": {"memory": "displacement_gap"},
    "two": {"memory": "two_displacements", "t_max": 0},
    "misses": {"memory": "displacement", "detection": 0.7},
    "safe action misses": {"memory": "displacement_gap", "safe_detection": 0.6, "detection": 0.8},
    "cut": {"memory": "displacement", "max_steps": 3},
    "stopped": {"memory": "displacement"},
}


def problem(kind: str) -> Any:
    tracks = drawn(small_world(exit_probability=0.1).kernel, 60)
    if kind == "stopped":
        tracks.exits[::2] = False
    return recorded(tracks, **KINDS[kind])


def random_policy(task: Any, seed: int) -> PolicyTable:
    rng = np.random.default_rng(seed)
    shape = (task.num_keys * task.num_choices, task.total_sensors)
    return PolicyTable(task, sparse.csr_array(rng.random(shape) < rng.uniform(0.05, 0.7)))


@pytest.mark.parametrize("kind", KINDS)
def test_each_policy_is_worth_what_it_is_worth_by_itself(kind: str) -> None:
    task = problem(kind)
    replays = Replays(task)
    others = [task.remembering(), task]
    for seed, keyed in enumerate([task, task, *others, task]):
        policy = random_policy(keyed, seed)
        found, alone = replays.value(policy), value_of(task, policy)
        assert (found.aihtr, found.accuracy) == (alone.aihtr, alone.accuracy)
        np.testing.assert_array_equal(found.starts, alone.starts)


@pytest.mark.parametrize("kind", KINDS)
def test_a_policy_leads_to_its_events_alone(kind: str) -> None:
    task = problem(kind)
    motion, keys = task.motion, task.keys
    everything, known = all_events(task, keys, motion), Reach(task, keys, motion)
    fewer = 0
    for seed in range(4):
        reports = random_policy(task, seed).sensed_by(task).reports
        found = known.under(reports)
        np.testing.assert_array_equal(found.codes, all_events(task, keys, motion, reports).codes)
        fewer += len(found.codes) < len(everything.codes)
    assert fewer


def test_what_would_be_too_much_is_not_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    task = problem("gap")
    policy = random_policy(task, 0)
    most = task.motion.num_states * (task.t_max + 2)
    for limit, kept in ((most, 1), (most - 1, 0)):
        monkeypatch.setattr(reach, "_MOST", limit)
        made: list[Reach] = []
        monkeypatch.setattr(reach, "Reach", lambda *of: made.append(Reach(*of)) or made[-1])  # noqa: B023
        assert Replays(task).value(policy).aihtr == value_of(task, policy).aihtr
        assert len(made) == kept
