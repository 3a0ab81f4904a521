"""One small object of each class that is shown at a prompt."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import trackmdp as tm
from tests.helpers import headings
from trackmdp.arrays.entries import ends_of
from trackmdp.recordings.tracks import Tracks

SHORT = {"total_frames": 4000, "frames_per_batch": 2000, "envs": 50}


def recorded() -> tm.Recorded:
    """Three tracks on 3 x 3 cells; the first runs along the upper row and leaves."""
    cells = [[0, 1, 2, 2], [4, 4, 5], [8, 7, 4]]
    parts = [
        Tracks(np.array(each), ends_of(np.array([len(each)])), np.array([True]), np.array([name]))
        for name, each in enumerate(cells)
    ]
    return tm.Recorded(parts[0], 3, validation=parts[1], held_out=parts[2], cost=0.1, t_max=1)


@cache
def objects() -> dict[str, Any]:
    """Name -> object."""
    world = tm.make_world(size=(3, 4), cost=0.16)
    run = tm.train(world, "model_based", seed=3, **SHORT)
    solution = tm.solve(world)
    tradeoff = tm.frontier(tm.make_world("drift", size=3), resolution=0.1)
    group = tm.Group([world, tm.make_world("random_walk", size=(3, 4), cost=0.16)])
    return {
        "world": world,
        "group": group,
        "group_episodes": tm.simulate(group, "all_on", 2),
        "group_evaluation": tm.evaluate(group, "none", width=0.1),
        "hidden": headings(),
        "recorded": recorded(),
        "task": world.task,
        "run": run,
        "in_folder": replace(run, folder=Path("runs") / "<a & b>"),
        "solution": solution,
        "evaluation": solution.evaluation,
        "episodes": tm.simulate(world, solution, 6),
        "episode": tm.simulate(world, solution, 1)[0],
        "comparison": tm.compare(world, ["qmdp", solution]),
        "policy": solution.policy,
        "tradeoff": tradeoff,
        "corner": tradeoff.corners[1],
        "mixture": tradeoff.at(accuracy=0.9),
    }


NAMES = (
    "world",
    "group",
    "group_episodes",
    "group_evaluation",
    "hidden",
    "recorded",
    "task",
    "run",
    "in_folder",
    "solution",
    "evaluation",
    "episodes",
    "episode",
    "comparison",
    "policy",
    "tradeoff",
    "corner",
    "mixture",
)
