"""An episode as a web page."""

from __future__ import annotations

import html
import json
from importlib.resources import files
from typing import Any

import numpy as np

from trackmdp.arrays.types import BoolArray
from trackmdp.episodes.episode import Episode
from trackmdp.episodes.target_colours import COLOURS
from trackmdp.sensing.task import Task
from trackmdp.solvers import bounds
from trackmdp.world.group import Group, Subject
from trackmdp.world.model import World

MOST_STEPS = 2000
"""Steps on a page, or frames of a video; a longer episode is cut there, with a note on the page."""

PAGE_WIDE = 41
"""Rows and columns of a grid that are drawn at most: those around the target."""

_MOST_CELLS = 100
"""Shaded cells of a step, the likeliest."""


def page(problem: Subject, episode: Episode, label: str = "", seed: str = "") -> str:
    """The page as text.

    Args:
        problem: where the episode took place.
        episode: with its belief.
        label: of its policy.
        seed: of its run.
    """
    template = files("trackmdp.episodes").joinpath("page.html").read_text(encoding="utf-8")
    content = _content(problem, episode) | {"about": _about(problem, episode, seed)}
    text = json.dumps(content, separators=(",", ":"), allow_nan=False)
    title = html.escape(f"Episode {episode.number}" + (f": {label}" if label else ""))
    title = title.replace("@", "&#64;")  # a label may hold a mark of the template
    # `<` inside the JSON could close its element
    return template.replace("@TITLE@", title).replace("@DATA@", text.replace("<", "\\u003c"))


def _about(problem: Subject, episode: Episode, seed: str) -> str:
    """The line under the title."""
    rows, columns = problem.task.size
    about = [f"{rows} x {columns} grid, {len(episode)} steps"]
    targets = len(problem.targets)
    about[0] += f", {targets} targets" if targets else ""
    about[0] += " along held-out tracks" if problem.recorded else ""
    about[0] += f", seed {seed}" if seed else ""
    if len(episode) > MOST_STEPS:
        about.append(f"the first {MOST_STEPS:,} steps are shown")
    if max(rows, columns) > PAGE_WIDE:
        size = f"{min(rows, PAGE_WIDE)} x {min(columns, PAGE_WIDE)} cells"
        about.append(f"of the grid, the {size} around the target{'s' * (targets > 0)}")
    return "; ".join(about)


def _content(problem: Subject, episode: Episode) -> dict[str, Any]:
    """The data of the page: of one target all at once, of several a part for each under `targets`."""
    shown, task = slice(0, MOST_STEPS), problem.task
    worlds = problem.worlds if isinstance(problem, Group) else [problem.model]
    singles = zip(episode.singles(), worlds, strict=True)
    targets = [_of_target(single, world, task) for single, world in singles]
    own = {"targets": targets, "colours": COLOURS} if problem.targets else targets[0]
    return own | {
        # Of the start cell; there is none without a motion model, or of several targets.
        "bound": problem.model and float(bounds.clocked(problem.model)[episode.start]),
        "rows": task.rows,
        "columns": task.columns,
        "wide": PAGE_WIDE,
        "forced": episode.forced(task.t_max)[shown].astype(int).tolist(),
        "reward": episode.reward[shown].tolist(),
        "total": episode.returns[shown].tolist(),
        "on": episode.action[shown].sum(axis=1).tolist(),
        "sensed": [_runs(row) for row in task.covered(episode.action[shown])],
        "frame": "sensor on" if task.coverage is None else "cell sensed",
    }


def _of_target(episode: Episode, world: World | None, task: Task) -> dict[str, Any]:
    """Where a target was, and where it was expected; its modes, and their mean steps, where it has some."""
    shown = slice(0, MOST_STEPS)
    target = np.where(episode.target == task.num_cells, -1, episode.target)
    modes: dict[str, Any] = {}
    if world is not None and episode.mode is not None:
        modes = {"mode": episode.mode[shown].tolist(), "drift": world.drift.round(3).tolist()}
    return modes | {
        "start": -1 if episode.start == task.num_cells else int(episode.start),
        "target": target[shown].tolist(),
        "located": episode.located[shown].astype(int).tolist(),
        "n": episode.misses[shown].tolist(),
        "belief": [_sparse(row) for row in episode.belief[shown]],
    }


def _runs(sensed: BoolArray) -> list[int]:
    """First cell of a run of sensed ones, the first after it, and so on: of 1 1 0 1 they are 0, 2, 3, 4."""
    return np.flatnonzero(np.diff(sensed, prepend=False, append=False)).tolist()


def _sparse(belief: Any) -> list[int]:
    """Cell, probability in ten-thousandths, cell, ...: the likeliest cells, in their order."""
    share = np.rint(belief * 10_000).astype(int)
    # Stable: among equally likely cells always the same ones are kept, so that a page is the same bytes each time.
    cells = np.sort(np.argsort(-share, kind="stable")[:_MOST_CELLS])
    cells = cells[share[cells] > 0]
    return np.stack([cells, share[cells]], axis=1).ravel().tolist()
