"""The page of a policy on recorded tracks: its reward beside others, its sensors on the map, one track step by step."""

from __future__ import annotations

import html
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from trackmdp.arrays.types import Array
from trackmdp.episodes.episode import Episode
from trackmdp.notebook.card import counted_words, span
from trackmdp.recordings.gridding import said
from trackmdp.recordings.tracks import Recorded
from trackmdp.reports.page import Report, Section
from trackmdp.reports.tables import Cell, Column, Rows, Table, interval_columns, paragraphs
from trackmdp.solvers.evaluation import ReplayedTracks

_STEPS = 8
"""Steps of a track that are drawn."""
_MOST_TRACKS = 400
"""Tracks with a line; all of them count in the shades."""
_FIGURES = {
    "reward_per_step": Column("reward per step", 4),
    "accuracy": Column("located", 1, "%"),
    "sensors_per_step": Column("sensors per step", 2),
    "aihtr": Column("AIHTR", 2),
}


@dataclass(frozen=True)
class Extent:
    """Rows and columns of a grid, from `top` and `left` on."""

    top: int
    left: int
    rows: int
    columns: int


def recorded_page(
    problem: Recorded,
    subject: str,
    report: Mapping[str, Any],
    replayed: Mapping[str, ReplayedTracks],
    episodes: Mapping[str, Sequence[Episode]],
) -> Report:
    """The page.

    Args:
        problem: the tracks and the task.
        subject: name of the policy.
        report: of `HeldOutEvaluator`.
        replayed: name of a policy in the report -> its actions on the held-out tracks; the policies that are drawn.
        episodes: the same names -> each policy on some held-out tracks, the same for all.
    """
    # `trained` adds the file of the checkpoint to the name of the algorithm.
    own = subject.partition(", ")[0]
    names = {name: own if name == "policy" else name for name in report["figures"]}
    chosen = {
        name: max(each, key=lambda one: len(np.unique(one.target[:_STEPS])))
        for name, each in episodes.items()
    }
    part = _part(problem, chosen.values())
    tracks = len(next(iter(episodes.values())))
    where = (
        f"Drawn: rows {part.top + 1} to {part.top + part.rows}, columns {part.left + 1} to "
        f"{part.left + part.columns}, the dashed frame in the maps."
    )
    note = f"{paragraphs('trackmdp.reports')['steps'].format(steps=_STEPS, tracks=tracks)} {where}"
    strips = [
        f"<h3>{html.escape(names[name])}</h3>{_strip(problem, each, part)}"
        for name, each in chosen.items()
    ]
    sections = [
        Section("earns", "Rewards", [_table(names, report)]),
        Section("where", "Sensors on the map", [_maps(problem, names, replayed, part)]),
        Section(
            "steps", "One held-out track, step by step", [f"<p>{html.escape(note)}</p>", *strips]
        ),
    ]
    return Report(_about(problem, report), sections, title="A policy on recorded tracks")


def _about(problem: Recorded, report: Mapping[str, Any]) -> str:
    prices = span(np.nanmin(problem.cost), np.nanmax(problem.cost))
    text = (
        f"{counted_words(report['tracks'], 'held-out track')}, {report['learned_from']:,} to learn from, "
        f"{report['validation']:,} to choose by; {problem.rows} x {problem.columns} cells, "
        f"T_max {problem.t_max}, r {problem.reward:g}, c {prices}, D {problem.safe_cost:g}."
    )
    return f"{text} Loaded: {said(problem.loaded)}." if problem.loaded else text


def _table(names: Mapping[str, str], report: Mapping[str, Any]) -> Table:
    columns = [Column("policy")]
    for column in _FIGURES.values():
        columns += [column, *interval_columns(column.digits)]
    rows: Rows = []
    for name, figures in report["figures"].items():
        row: list[Cell] = [names[name]]
        for key, column in _FIGURES.items():
            ends = (figures[key][end] for end in ("mean", "low", "high"))
            factor = 100 if column.unit == "%" else 1
            row += [None if end is None else factor * end for end in ends]
        rows.append(row)
    caption = f"Means over {counted_words(report['tracks'], 'held-out track')} with 95 % intervals over targets"
    return Table("held-out", caption, columns, rows)


def _maps(
    problem: Recorded,
    names: Mapping[str, str],
    replayed: Mapping[str, ReplayedTracks],
    part: Extent,
) -> str:
    """The recording, and for each policy the share of steps in which a cell is sensed, in the same shades."""
    tracks = problem.held_out
    visits = np.bincount(tracks.cells, minlength=problem.num_cells).astype(np.float64)
    frame = _box(part, 'stroke="var(--text)" stroke-dasharray=".4 .3"')
    recording = _map(
        problem, visits, visits.max(), f"{visits.max():,.0f} visits", _lines(problem) + frame
    )
    drawn = [_figure(recording, "The held-out tracks, on the cells they visit.")]
    shares = {
        name: each.watched / max(each.totals[:, 1].sum(), 1) for name, each in replayed.items()
    }
    most = max(float(share.max()) for share in shares.values()) or 1.0
    for name, share in shares.items():
        caption = f"{names[name]}: share of the steps in which a cell is sensed."
        drawn.append(_figure(_map(problem, share, most, f"{most:.1%}", frame), caption))
    return f'<div class="figures">{"".join(drawn)}</div>'


def _map(problem: Recorded, values: Array, most: float, label: str, above: str) -> str:
    """Cells shaded by `values` `[M]` from 0 to `most`; below them a legend of the shades, a scale bar and north."""
    shades = (f'<span style="opacity:{(k / 4) ** 0.5:.2f}">■</span>' for k in range(1, 5))
    legend = f'0 <span style="color:var(--blue)">{"".join(shades)}</span> {html.escape(label)}'
    if place := problem.place:
        length = _round_length(problem.columns * place.cell / 3)
        wide = 100 * length / (problem.columns * place.cell)
        north = "north" if place.crs else "y"
        words = f"{length:g}{' m' if place.crs else ''}; {north} points {'down' if place.downwards else 'up'}"
        legend += f'<div style="border-top:3px solid;width:{wide:.1f}%"></div>{words}'
    whole = Extent(0, 0, problem.rows, problem.columns)
    drawing = _svg(whole, f"{_shaded(problem, values / most)}{above}")
    return f'{drawing}<div class="legend">{legend}</div>'


def _round_length(most: float) -> float:
    """The largest of 1, 2, 5, 10, ... that is at most `most`."""
    power = 10.0 ** math.floor(math.log10(most))
    return max(factor * power for factor in (1, 2, 5) if factor * power <= most)


def _lines(problem: Recorded) -> str:
    """Tracks as lines from cell to cell."""
    tracks = problem.held_out
    drawn = np.linspace(0, len(tracks) - 1, min(len(tracks), _MOST_TRACKS)).astype(np.int64)
    x, y = tracks.cells % problem.columns + 0.5, tracks.cells // problem.columns + 0.5
    paths = (
        " ".join(f"{a:g},{b:g}" for a, b in zip(x[begin:end], y[begin:end], strict=True))
        for begin, end in zip(tracks.first[drawn], tracks.first[drawn + 1], strict=True)
    )
    lines = "".join(f'<polyline points="{path}"/>' for path in paths)
    style = 'fill="none" stroke="var(--vermilion)" stroke-width=".08" stroke-opacity=".35" stroke-linejoin="round"'
    return f"<g {style}>{lines}</g>"


def _shaded(problem: Recorded, share: Array) -> str:
    """Squares of the cells with `share` `[M]` above 0; their opacity is its root, so that small shares are seen."""
    cells = np.flatnonzero(share > 0).tolist()
    places = (f"M{cell % problem.columns} {cell // problem.columns}h1v1h-1z" for cell in cells)
    squares = (
        f'<path d="{place}" fill-opacity="{share[cell] ** 0.5:.2f}"/>'
        for place, cell in zip(places, cells, strict=True)
    )
    return f'<g fill="var(--blue)">{"".join(squares)}</g>'


def _part(problem: Recorded, episodes: Iterable[Episode]) -> Extent:
    """The smallest part of the grid with all that is drawn of some episodes."""
    seen = np.zeros(problem.num_cells + 1, bool)  # the exit is cell M
    for episode in episodes:
        seen[[episode.start, *episode.target[:_STEPS]]] = True
        seen[:-1] |= problem.covered(episode.action[:_STEPS]).any(axis=0)
    rows, columns = np.divmod(np.flatnonzero(seen[:-1]), problem.columns)
    top, left = int(rows.min()), int(columns.min())
    return Extent(top, left, int(np.ptp(rows)) + 1, int(np.ptp(columns)) + 1)


def _strip(problem: Recorded, episode: Episode, part: Extent) -> str:
    """The first steps of an episode, side by side."""
    frames, forced = [], episode.forced(problem.t_max)
    cells = [int(episode.start), *episode.target[:_STEPS].tolist()]
    for t, cell in enumerate(cells[1:]):
        on = problem.covered(episode.action[t]) & (not forced[t])
        body, event = _shaded(problem, on.astype(np.float64)), "left"
        if cell < problem.num_cells:
            (y, x), (before_y, before_x) = (
                divmod(each, problem.columns) for each in (cell, cells[t])
            )
            line = f'<path d="M{x + 0.5} {y + 0.5}L{before_x + 0.5} {before_y + 0.5}"/>'
            fill = "vermilion" if episode.located[t] else "page"
            disc = f'<circle cx="{x + 0.5}" cy="{y + 0.5}" r=".3" fill="var(--{fill})"/>'
            body += f'<g stroke="var(--vermilion)" stroke-width=".12">{line}{disc}</g>'
            event = "safe action" if forced[t] else f"{int(episode.action[t].sum())} on"
        frames.append(f'<div>{_svg(part, body)}<span class="faint">{t + 1}: {event}</span></div>')
    style = "display:grid;gap:10px;grid-template-columns:repeat(auto-fill,minmax(120px,1fr))"
    return f'<div style="{style}">{"".join(frames)}</div>'


def _box(part: Extent, style: str) -> str:
    edge = f"M{part.left} {part.top}h{part.columns}v{part.rows}h-{part.columns}z"
    return f'<path d="{edge}" fill="none" stroke-width=".1" {style}/>'


def _svg(part: Extent, body: str) -> str:
    """A drawing in units of cells: a part of the grid with a line around it."""
    view = f"{part.left - 0.1:g} {part.top - 0.1:g} {part.columns + 0.2:g} {part.rows + 0.2:g}"
    box = _box(part, 'stroke="var(--line)"')
    return f'<svg class="chart" viewBox="{view}" aria-hidden="true">{body}{box}</svg>'


def _figure(drawing: str, caption: str) -> str:
    return f"<figure>{drawing}<figcaption>{html.escape(caption)}</figcaption></figure>"
