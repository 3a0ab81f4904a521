"""The page of a policy on recorded tracks: what it earns beside others, where it senses, and one track step by step."""

from __future__ import annotations

import html
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from trackmdp.episodes.episode import Episode
from trackmdp.reports.page import Report, Section
from trackmdp.reports.tables import Cell, Column, Table, paragraphs
from trackmdp.solvers.recorded import ReplayedTracks
from trackmdp.world.gridding import said
from trackmdp.world.model import Array
from trackmdp.world.tracks import Recorded, Tracks

_STEPS = 8
"""Steps of a track that are drawn."""
_MOST_TRACKS = 400
"""Tracks whose lines are drawn; the others count in the shades."""
_FIGURES = {"reward_per_step": ("reward per step", 1, 4), "accuracy": ("located, %", 100, 1)}
_FIGURES |= {"sensors_per_step": ("sensors per step", 1, 2)}
"""Figure -> its column, factor and decimals."""


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
        subject: what "policy" is called.
        report: of `HeldOutEvaluator`.
        replayed: name of a policy in the report -> what it did on the held-out tracks; the policies that are drawn.
        episodes: the same names -> each policy on some held-out tracks, the same for all.
    """
    names = {name: subject if name == "policy" else name for name in report["figures"]}
    about = (
        f"{report['tracks']:,} held-out tracks, {report['learned_from']:,} to learn from, {report['validation']:,} to "
        f"choose by; {problem.rows} x {problem.columns} cells, T_max {problem.t_max}, r {problem.reward:g}, "
        f"c {' to '.join(f'{each:g}' for each in {problem.cost.min(): 0, problem.cost.max(): 0})}, "
        f"D {problem.safe_cost:g}. "
    )
    shares = {name: each.watched / max(each.totals[:, 1].sum(), 1) for name, each in replayed.items()}
    most = max(float(share.max()) for share in shares.values())
    maps = [_figure(_recording(problem), "The held-out tracks, on the cells they visit (stronger: more often).")]
    for name, share in shares.items():
        about_it = f"share of steps in which a cell is sensed, at most {share.max():.1%}; same shades in all."
        drawing = _svg(problem.size, _shaded(problem, share / (most or 1.0)))
        maps.append(_figure(drawing, f"{names[name]}: {about_it}"))
    chosen = {name: max(each, key=lambda one: len(np.unique(one.target[:_STEPS]))) for name, each in episodes.items()}
    part = _part(problem, chosen.values())
    strips = [f"<h3>{html.escape(names[name])}</h3>{_strip(problem, each, part)}" for name, each in chosen.items()]
    note = f"<p>{paragraphs('trackmdp.reports')['steps'].format(steps=_STEPS)}</p>"
    sections = [
        Section("earns", "What it earns", [_table(names, report)]),
        Section("where", "Where it senses", [f'<div class="figures">{"".join(maps)}</div>']),
        Section("steps", "One held-out track, step by step", [note, *strips]),
    ]
    about += f"Loaded: {said(problem.loaded)}." if problem.loaded else ""
    return Report(html.escape(about), sections, title="A policy on recorded tracks")


def _table(names: Mapping[str, str], report: Mapping[str, Any]) -> Table:
    columns = [Column("policy")]
    for label, _, digits in _FIGURES.values():
        columns += [Column(label, digits), Column("95 %")]
    rows: list[list[Cell]] = []
    for name, figures in report["figures"].items():
        row: list[Cell] = [names[name]]
        for key, (_, factor, digits) in _FIGURES.items():
            mean, low, high = (figures[key][end] for end in ("mean", "low", "high"))
            ends = [Column("", digits).text(None if end is None else factor * end) for end in (low, high)]
            row += [factor * mean, " ... ".join(ends)]
        rows.append(row)
    caption = f"Means over {report['tracks']:,} held-out tracks with 95 % intervals over targets"
    return Table("held-out", caption, columns, rows)


def _recording(problem: Recorded) -> str:
    """The cells shaded by visits, and the tracks as lines from cell to cell."""
    tracks: Tracks = problem.held_out
    visits = np.bincount(tracks.cells, minlength=problem.num_cells).astype(np.float64)
    drawn = np.linspace(0, len(tracks) - 1, min(len(tracks), _MOST_TRACKS)).astype(np.int64)
    x, y = tracks.cells % problem.columns + 0.5, tracks.cells // problem.columns + 0.5
    paths = (
        " ".join(f"{a:g},{b:g}" for a, b in zip(x[begin:end], y[begin:end], strict=True))
        for begin, end in zip(tracks.first[drawn], tracks.first[drawn + 1], strict=True)
    )
    lines = "".join(f'<polyline points="{path}"/>' for path in paths)
    style = 'fill="none" stroke="var(--vermilion)" stroke-width=".08" stroke-opacity=".35" stroke-linejoin="round"'
    return _svg(problem.size, f"{_shaded(problem, visits / visits.max())}<g {style}>{lines}</g>")


def _shaded(problem: Recorded, share: Array) -> str:
    """Squares of the cells with `share` `[M]` above 0; their opacity grows with its root, so that small ones show."""
    places = zip(np.flatnonzero(share > 0), share[share > 0] ** 0.5, strict=True)
    corners = ((cell % problem.columns, cell // problem.columns, depth) for cell, depth in places)
    squares = (f'<path d="M{x} {y}h1v1h-1z" fill-opacity="{depth:.2f}"/>' for x, y, depth in corners)
    return f'<g fill="var(--blue)">{"".join(squares)}</g>'


def _part(problem: Recorded, episodes: Iterable[Episode]) -> tuple[tuple[int, int], tuple[int, int]]:
    """Rows and columns of the smallest part of the grid with all that is drawn of some episodes, and its corner."""
    seen = np.zeros(problem.num_cells + 1, dtype=bool)  # the exit is cell M
    for episode in episodes:
        seen[[episode.start, *episode.target[:_STEPS]]] = True
        seen[:-1] |= problem.covered(episode.action[:_STEPS]).any(axis=0)
    rows, columns = np.divmod(np.flatnonzero(seen[:-1]), problem.columns)
    return (int(np.ptp(rows)) + 1, int(np.ptp(columns)) + 1), (int(rows.min()), int(columns.min()))


def _strip(problem: Recorded, episode: Episode, part: tuple[tuple[int, int], tuple[int, int]]) -> str:
    """The first steps of an episode, side by side."""
    frames, forced = [], episode.forced(problem.t_max)
    for t, cell in enumerate(episode.target[:_STEPS].tolist()):
        on = problem.covered(episode.action[t]) & (not forced[t])
        body = _shaded(problem, on.astype(np.float64))
        if cell < problem.num_cells:
            x, y = cell % problem.columns + 0.5, cell // problem.columns + 0.5
            before = int(episode.target[t - 1] if t else episode.start)
            line = f'<path d="M{x} {y}L{before % problem.columns + 0.5} {before // problem.columns + 0.5}"/>'
            disc = f'<circle cx="{x}" cy="{y}" r=".3" fill="var(--{"vermilion" if episode.located[t] else "page"})"/>'
            body += f'<g stroke="var(--vermilion)" stroke-width=".12">{line}{disc}</g>'
            what = "safe action" if forced[t] else f"{int(episode.action[t].sum())} on"
        else:
            what = "left"
        frames.append(f'<div>{_svg(part[0], body, part[1])}<span class="faint">{t + 1}: {what}</span></div>')
    style = "display:grid;gap:10px;grid-template-columns:repeat(auto-fill,minmax(120px,1fr))"
    return f'<div style="{style}">{"".join(frames)}</div>'


def _svg(size: Iterable[int], body: str, corner: tuple[int, int] = (0, 0)) -> str:
    """A drawing in units of cells, of `size` rows and columns from `corner` on, with a line around it."""
    (rows, columns), (top, left) = size, corner
    box = f'<path d="M{left} {top}h{columns}v{rows}h-{columns}z" fill="none" stroke="var(--line)" stroke-width=".1"/>'
    view = f"{left - 0.1:g} {top - 0.1:g} {columns + 0.2:g} {rows + 0.2:g}"
    return f'<svg class="chart" viewBox="{view}" aria-hidden="true">{body}{box}</svg>'


def _figure(drawing: str, caption: str) -> str:
    return f"<figure>{drawing}<figcaption>{html.escape(caption)}</figcaption></figure>"
