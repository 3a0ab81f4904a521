"""Episodes of several targets: against the environment, by a tracker, and into a log and back."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict

from tests.episodes.logs import CONFIG
from trackmdp.environment.group_dynamics import GroupDynamics
from trackmdp.environment.group_paths import GroupPaths
from trackmdp.episodes.episode import Episode
from trackmdp.episodes.writer import EpisodeWriter
from trackmdp.seeding import derive
from trackmdp.solvers.several.group_tracker import GroupTracker
from trackmdp.solvers.several.merging import Rule
from trackmdp.world.group import Group


def check_steps(group: Group, episodes: Iterable[Episode], rule: Rule | None = None) -> None:
    """The environment makes the same steps of an episode's draws and actions, to the bit; and the rule the actions."""
    paths, count = GroupPaths(group, held_out=True), len(group)
    dynamics = GroupDynamics(group.task, paths, count)
    for episode in episodes:
        moves, reports = (
            torch.Generator().manual_seed(seed)
            for seed in (episode.seed, derive(episode.seed, "report"))
        )
        state = dynamics.start(paths.begin(moves))
        drawn = paths.sampler.draw(256 * count, moves).view(-1, count)
        seen = torch.rand(256, count, dtype=torch.float64, generator=reports)
        for step, move, report in zip(episode.to_tensordict(group.task), drawn, seen, strict=False):
            if rule is not None:
                assert torch.equal(rule(TensorDict(state, 1))["action"][0], step["action"])
            state = dynamics.advance(state, step["action"][None], move, report)
            for key, expected in step["next"].items():
                assert torch.equal(state[key][0], expected), key


def tracked(rule: Rule, episode: Episode) -> Iterator[GroupTracker]:
    """A tracker after each step, saved and restored before it, that would have switched on the same sensors."""
    tracker, cells = GroupTracker(rule, episode.start.tolist()), rule.task.num_cells
    for on, now, found in zip(episode.action, episode.target, episode.located, strict=True):
        tracker = GroupTracker.restore(rule, json.loads(json.dumps(tracker.state())))
        sensors = tracker.sensors()
        assert tracker.safe or sensors == np.flatnonzero(on).tolist()
        shown = [int(cell) if hit else None for cell, hit in zip(now, found, strict=True)]
        tracker.report(shown, gone=np.flatnonzero(now == cells).tolist())
        yield tracker


def write(file: Path, episodes: Iterable[Episode], rule: Rule) -> Path:
    """A log of the episodes of one policy."""
    writer = EpisodeWriter.of(file, rule.group, facts={"seed": "0"}, config=CONFIG)
    writer.add_policy({"label": "mine"}, rule)
    for episode in episodes:
        writer.add(episode)
    return writer.finish()
