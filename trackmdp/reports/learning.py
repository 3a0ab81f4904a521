"""How the policies got there: regret while learning, and the share of runs that come close."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from trackmdp.reports.figures import ALLOWED, FLOOR, estimate_columns, parts
from trackmdp.reports.grouping import Study
from trackmdp.reports.results import Point, Run
from trackmdp.reports.statistics import Estimate, estimate, profile
from trackmdp.reports.style import INK, Figure, draw, legend, look, tidy
from trackmdp.reports.tables import Column, Table
from trackmdp.world.model import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

__all__ = ["curves", "profiles", "value_at"]


def curves(study: Study, points: Mapping[str, Sequence[Point]], by: str, resamples: int) -> Figure | None:
    """Regret per step while learning, over all worlds, against `frames` or `seconds`."""
    averaged = {method: _averaged(study, method, points, by, resamples) for method in study.methods}
    found = {method: curve for method, curve in averaged.items() if curve is not None}
    if not found:
        return None
    unit = {"frames": "env steps", "seconds": "wall seconds of learning"}[by]

    def paint(figure: Canvas) -> None:
        axes = figure.subplots()
        for place, (method, (grid, row)) in enumerate(found.items()):
            style = look(method, place)
            mean = np.maximum([e.mean for e in row], FLOOR)
            axes.plot(grid, mean, style.line, color=style.colour, label=method, marker=style.marker, markevery=6)
            if row[0].low is not None:
                low, high = (np.maximum([getattr(e, side) for e in row], FLOOR) for side in ("low", "high"))
                axes.fill_between(grid, low, high, color=style.colour, alpha=0.18, linewidth=0)
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xlabel(unit)
        axes.set_ylabel("regret per step")
        tidy(axes)
        legend(figure, axes)

    columns = [Column("method"), Column(unit, 1 if by == "seconds" else 0), *estimate_columns("regret per step", 5)]
    rows = [
        [method, float(grid[place]), *parts(row[place])]
        for method, (grid, row) in found.items()
        for place in range(0, len(grid), 3)
    ]
    counts = ", ".join(f"{method} n = {row[0].n}" for method, (_, row) in found.items())
    title = (
        f"Regret while learning against {unit}: interquartile mean over worlds and seeds with 95 % interval; {counts}"
    )
    ends = ", ".join(f"{m} {row[-1].mean:.4f} after {grid[-1]:,.0f}" for m, (grid, row) in found.items())
    table = Table(f"learning-{by}", title, columns, rows)
    return draw(f"learning-{by}", title, f"Regret per step at the end: {ends} {unit}.", table, 3.3, paint)


def _averaged(
    study: Study, method: str, points: Mapping[str, Sequence[Point]], by: str, resamples: int
) -> tuple[Array, list[Estimate]] | None:
    """Positions `[G]` and the estimates there over all runs of a method; None where no curve is known.

    The positions begin where every run has been judged, and end with the longest.
    """
    groups = [[_steps(study, run, world, points, by) for run in study.of(world, method)] for world in study.worlds]
    known = [[curve for curve in group if len(curve)] for group in groups]
    everything = [curve for group in known for curve in group]
    if not everything:
        return None
    start, end = (float(max(curve[place, 0] for curve in everything)) for place in (0, -1))
    grid = np.geomspace(max(start, 1e-2), max(end, start * 1.001), 40)
    values = [[np.array([value_at(curve, x) for x in grid]) for curve in group] for group in known]
    return grid, [
        estimate([[v[i] for v in g] for g in values], "learning", by, method, str(i), resamples=resamples)
        for i in range(len(grid))
    ]


def profiles(study: Study, resamples: int) -> Figure | None:
    """The share of runs whose regret is at most τ."""
    regrets = {m: [study.regrets(world, m) for world in study.worlds] for m in study.methods}
    groups = {method: groups for method, groups in regrets.items() if any(groups)}
    if not groups:
        return None
    everything = np.array([value for method in groups.values() for group in method for value in group])
    levels = np.geomspace(1e-4, max(1.0, float(everything.max()) * 1.05), 60)
    found = {m: profile(g, levels, "profile", m, resamples=resamples) for m, g in groups.items()}
    counts = {method: sum(map(len, group)) for method, group in groups.items()}

    def paint(figure: Canvas) -> None:
        axes = figure.subplots()
        for place, (method, (share, interval)) in enumerate(found.items()):
            style = look(method, place)
            axes.plot(levels, share, style.line, color=style.colour, label=f"{method} (n = {counts[method]})")
            axes.fill_between(levels, *interval, color=style.colour, alpha=0.18, linewidth=0)
        for level in ALLOWED:
            axes.axvline(level, color=INK, linewidth=0.6, linestyle=(0, (1, 2)))
        axes.set_xscale("log")
        axes.set_ylim(-0.02, 1.02)
        axes.set_xlabel("τ, regret per step")
        axes.set_ylabel("share of runs with regret ≤ τ")
        tidy(axes)
        legend(figure, axes, columns=2)

    title = "Performance profiles: share of runs whose regret per step is at most τ, with 95 % interval; " + ", ".join(
        f"{method} n = {n}" for method, n in counts.items()
    )
    marks = (0.001, 0.005, 0.01, 0.02, 0.05, 0.1)
    share_of = {m: [float(np.mean([v <= mark for g in groups[m] for v in g])) for mark in marks] for m in groups}
    columns = [Column("method"), Column("n"), *(Column(f"≤ {mark:g}", 2) for mark in marks)]
    table = Table("profiles", title, columns, [[m, counts[m], *share_of[m]] for m in groups])
    text = "; ".join(
        f"{m}: {share_of[m][2]:.0%} of runs at most 0.01, {share_of[m][3]:.0%} at most 0.02" for m in groups
    )
    return draw("profiles", title, text + ".", table, 3.3, paint)


def _steps(study: Study, run: Run, world: str, curves: Mapping[str, Sequence[Point]], by: str) -> Array:
    """`[points, 2]` position and regret of one run; of several points at one position the last counts."""
    if math.isnan(study.upper(world)):
        return np.zeros((0, 2))
    last = {float(getattr(p, by)): study.regret(run, world, p.aihtr) for p in curves.get(run.name, ())}
    return np.array(sorted(last.items()))


def value_at(curve: Array, x: float) -> float:
    """The regret of the last policy judged at or before x; before the first, the first's."""
    place = int(np.searchsorted(curve[:, 0], x * (1 + 1e-9), side="right")) - 1
    return float(curve[max(place, 0), 1])
