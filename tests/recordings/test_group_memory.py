"""Recorded tracks that several targets follow, each with a plan that remembers its own past detections."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import trackmdp as tm
from tests.episodes import groups
from tests.helpers import later
from tests.recordings.test_together import several
from trackmdp.environment.env import TrackEnv
from trackmdp.episodes.reader import EpisodeReader, verify
from trackmdp.errors import UserError
from trackmdp.policies.table import PolicyTable
from trackmdp.solvers.evaluate import group_rule
from trackmdp.world.group import Group


def random_table(targets: Group) -> PolicyTable:
    assert targets.recorded is not None
    shape = targets.recorded.num_keys, 2, 9
    return PolicyTable.from_dense(targets.recorded, np.random.default_rng(2).random(shape) < 0.4)


@pytest.mark.parametrize(
    "memory", ["displacement_gap", *later(["displacement", "two_displacements"])]
)
@pytest.mark.parametrize("at_once", [True, False])
def test_each_target_has_the_plan_of_its_own_memory(
    at_once: bool, memory: str, tmp_path: Path
) -> None:
    """Sets, clocks and keys followed target by target; the log and a tracker that was saved do the same."""
    targets = several(3, memory=memory, clip=1, safe_detection=0.7)
    assert targets.recorded is not None
    if at_once:  # as a tracker needs it
        tracks = replace(targets.recorded.tracks, begins=None)
        targets = Group.of_tracks(replace(targets.recorded, tracks=tracks, held_out=tracks), 3)
    assert targets.recorded is not None
    assert "key" not in TrackEnv(targets, 2).observation_spec
    keys, table = targets.recorded.keys, random_table(targets)
    rule, remembered = group_rule(targets, table), 0
    episodes = tm.simulate(targets, rule, 40)
    for episode in episodes:
        before = [None if cell == 9 else keys.start(cell) for cell in episode.start.tolist()]
        n = [0] * 3
        if at_once:
            assert len(list(groups.tracked(rule, episode))) == len(episode)
        for t in range(len(episode)):
            due = [k for k in range(3) if before[k] is not None and n[k] > 1]
            expected = np.zeros(9, dtype=bool)
            for k in range(3):
                if before[k] is not None and not due:
                    expected |= table.dense()[before[k], n[k]]
            assert (episode.action[t] == expected).all()
            now = episode.target[t].tolist()
            for k in range(3):
                if now[k] == 9:
                    before[k] = None
                elif before[k] is None:
                    before[k], n[k] = keys.start(now[k]), 0
                elif episode.located[t, k]:
                    was = (np.int64(each) for each in (before[k], n[k], now[k]))
                    before[k], n[k] = int(keys.next(*was)), 0
                    remembered += before[k] != keys.start(now[k])
                else:
                    n[k] = min(n[k] + 1, 2)
    assert remembered > 100
    with EpisodeReader(groups.write(tmp_path / "a.mcap", episodes.complete(), rule)) as reader:
        assert verify(reader).difference is None
    with pytest.raises(UserError, match=r"targets.merge=union takes one that remembers more"):
        group_rule(targets, table, "gains")


def test_a_state_of_another_memory_is_refused() -> None:
    known = [several(3, memory=each, clip=1) for each in ("displacement", "displacement_gap")]
    mine, other = (group_rule(each, random_table(each)) for each in known)
    with pytest.raises(UserError, match=r"^state: made for .*'memory': 'displacement'.*expected"):
        tm.GroupTracker.restore(other, tm.GroupTracker(mine, [0, 1, 2]).state())
