"""An episode as a web page."""

from __future__ import annotations

import html
import json
from importlib.resources import files
from typing import Any

import numpy as np

from trackmdp.episodes.episode import Episode
from trackmdp.solvers import bounds
from trackmdp.world.tracks import Problem

MOST_STEPS = 2000
"""Steps on a page; a longer episode is cut there, with a note on the page."""

PAGE_WIDE = 41
"""Rows and columns of a grid that are drawn at most: those around the target."""

_MOST_CELLS = 100
"""Shaded cells of a step, the likeliest."""


def page(problem: Problem, episode: Episode, label: str = "", seed: str = "") -> str:
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
    # `<` inside the JSON could close its element
    return template.replace("@TITLE@", title).replace("@DATA@", text.replace("<", "\\u003c"))


def _about(problem: Problem, episode: Episode, seed: str) -> str:
    """The line under the title."""
    about = [f"{problem.rows} x {problem.columns} grid, {len(episode)} steps"]
    if problem.model is None:
        about[0] += " along a held-out track"
    about[0] += f", seed {seed}" if seed else ""
    if len(episode) > MOST_STEPS:
        about.append(f"the first {MOST_STEPS:,} steps are shown")
    if max(problem.size) > PAGE_WIDE:
        size = f"{min(problem.rows, PAGE_WIDE)} x {min(problem.columns, PAGE_WIDE)} cells"
        about.append(f"of the grid, the {size} around the target")
    return "; ".join(about)


def _bound(problem: Problem, start: int) -> float | None:
    """The clocked bound of a start cell; None without a motion model."""
    world = problem.model
    return None if world is None else float(bounds.clocked(world)[start])


def _content(problem: Problem, episode: Episode) -> dict[str, Any]:
    shown = slice(0, MOST_STEPS)
    target = np.where(episode.target == problem.num_cells, -1, episode.target)
    assert episode.belief is not None  # a logged episode has it
    modes = {}
    if (world := problem.model) and episode.mode is not None:
        modes = {"mode": episode.mode[shown].tolist(), "drift": world.drift.round(3).tolist()}
    return modes | {
        "rows": problem.rows,
        "columns": problem.columns,
        "wide": PAGE_WIDE,
        "bound": _bound(problem, episode.start),
        "start": int(episode.start),
        "target": target[shown].tolist(),
        "located": episode.located[shown].astype(int).tolist(),
        "forced": episode.forced(problem.t_max)[shown].astype(int).tolist(),
        "n": episode.misses[shown].tolist(),
        "reward": episode.reward[shown].tolist(),
        "total": episode.returns[shown].tolist(),
        "on": episode.action[shown].sum(axis=1).tolist(),
        "sensed": [row.nonzero()[0].tolist() for row in problem.covered(episode.action[shown])],
        "frame": "sensor on" if problem.coverage is None else "cell sensed",
        "belief": [_sparse(row) for row in episode.belief[shown]],
    }


def _sparse(belief: Any) -> list[int]:
    """Cell, probability in ten-thousandths, cell, ...: the likeliest cells, in their order."""
    share = np.rint(belief * 10_000).astype(int)
    # Stable: among equally likely cells always the same ones are kept, so that a page is the same bytes each time.
    cells = np.sort(np.argsort(-share, kind="stable")[:_MOST_CELLS])
    cells = cells[share[cells] > 0]
    return np.stack([cells, share[cells]], axis=1).ravel().tolist()
