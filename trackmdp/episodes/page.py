"""An episode as a web page, and episodes as tables."""

from __future__ import annotations

import csv
import html
import json
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from trackmdp.durable import write_text
from trackmdp.episodes.episode import Episode
from trackmdp.episodes.messages import step_messages
from trackmdp.episodes.reader import EpisodeReader
from trackmdp.solvers import bounds
from trackmdp.solvers.keyed_search import cell_bound
from trackmdp.world.modes import HiddenWorld

MOST_STEPS = 2000
"""Steps on a page; a longer episode is cut there, and the page says so."""

PAGE_WIDE = 41
"""Rows and columns of a grid that are drawn at most: those around the target."""

_MOST_CELLS = 100
"""Shaded cells of a step, the likeliest."""


def write_page(reader: EpisodeReader, file: Path, number: int | None = None) -> None:
    """Write the page of episode `number`, by default the first of the log.

    Raises:
        UserError: there is no such episode.
        OSError: the file cannot be written.
    """
    wanted = reader.rows[0]["episode"] if number is None else number
    write_text(file, page(reader, reader.read(wanted)))


def page(reader: EpisodeReader, episode: Episode) -> str:
    """The page as text."""
    template = files("trackmdp.episodes").joinpath("page.html").read_text(encoding="utf-8")
    content = json.dumps(_content(reader, episode), separators=(",", ":"), allow_nan=False)
    label = reader.policies[episode.policy].get("label", "")
    title = html.escape(f"Episode {episode.number}: {label}" if label else f"Episode {episode.number}")
    # `<` inside the JSON could close its element
    return template.replace("@TITLE@", title).replace("@DATA@", content.replace("<", "\\u003c"))


def _content(reader: EpisodeReader, episode: Episode) -> dict[str, Any]:
    world, shown = reader.world(), slice(0, MOST_STEPS)
    bound = cell_bound(world) if isinstance(world, HiddenWorld) else bounds.clocked(world)
    target = np.where(episode.target == world.num_cells, -1, episode.target)
    about = f"{world.rows} x {world.columns} grid, {len(episode)} steps, seed {reader.run.said.get('seed', '')}"
    if len(episode) > MOST_STEPS:
        about += f"; the first {MOST_STEPS:,} steps are shown"
    if max(world.size) > PAGE_WIDE:
        about += (
            f"; of the grid, the {min(world.rows, PAGE_WIDE)} x {min(world.columns, PAGE_WIDE)} cells around the target"
        )
    assert episode.belief is not None  # a logged episode has it
    modes = {}
    if isinstance(world, HiddenWorld) and episode.mode is not None:
        modes = {"mode": episode.mode[shown].tolist(), "drift": world.drift.round(3).tolist()}
    return modes | {
        "rows": world.rows,
        "columns": world.columns,
        "wide": PAGE_WIDE,
        "about": about,
        "bound": float(bound[episode.start]),
        "start": int(episode.start),
        "target": target[shown].tolist(),
        "located": episode.located[shown].astype(int).tolist(),
        "forced": episode.forced(world.t_max)[shown].astype(int).tolist(),
        "n": episode.misses[shown].tolist(),
        "reward": episode.reward[shown].tolist(),
        "total": episode.returns[shown].tolist(),
        "on": episode.action[shown].sum(axis=1).tolist(),
        "sensed": [row.nonzero()[0].tolist() for row in world.covered(episode.action[shown])],
        "frame": "sensor on" if world.coverage is None else "cell sensed",
        "belief": [_sparse(row) for row in episode.belief[shown]],
    }


def _sparse(belief: Any) -> list[int]:
    """Cell, probability in ten-thousandths, cell, ...: the likeliest cells, in their order."""
    share = np.rint(belief * 10_000).astype(int)
    # Stable: among equally likely cells always the same ones are kept, so that a page is the same bytes each time.
    cells = np.sort(np.argsort(-share, kind="stable")[:_MOST_CELLS])
    cells = cells[share[cells] > 0]
    return np.stack([cells, share[cells]], axis=1).ravel().tolist()


_STEP = ("episode", "t", "n", "last_cell", "active", "n_active", "forced", "target", "obs", "reward", "ep_return")


def write_tables(reader: EpisodeReader, folder: Path, number: int | None = None) -> None:
    """Write `steps.csv` and `episodes.csv` of all episodes, or of one.

    Cells are numbers, -1 for none; `active` holds the numbers of the sensors on, separated by blanks.
    """
    rows = [reader.row(number)] if number is not None else reader.rows
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "steps.csv").open("w", newline="", encoding="utf-8") as stream:
        columns = [*_STEP, "mode"] if reader.run.modes else _STEP
        table = csv.DictWriter(stream, columns, extrasaction="ignore")
        table.writeheader()
        for row in rows:
            for message in step_messages(reader.read(row["episode"]), reader.run):
                step = json.loads(message)
                table.writerow(step | {"active": " ".join(map(str, step["active"]))})
    with (folder / "episodes.csv").open("w", newline="", encoding="utf-8") as stream:
        table = csv.DictWriter(stream, list(reader.rows[0]) if reader.rows else ["episode"])
        table.writeheader()
        table.writerows(rows)
