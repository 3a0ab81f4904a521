"""Learning curves and performance profiles."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from trackmdp.reports.figures import FLOOR
from trackmdp.reports.grouping import Study
from trackmdp.reports.labels import label_lines
from trackmdp.reports.results import CurvePoint, FinishedRun
from trackmdp.reports.style import INK, Figure, draw_figure, legend, looks_of, tidy
from trackmdp.reports.summaries import estimate_cells, estimate_columns
from trackmdp.reports.tables import Cell, Column, Table
from trackmdp.statistics import MeanInterval, mean_over_groups, share
from trackmdp.world.model import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas


def curves(study: Study, points: Mapping[str, Sequence[CurvePoint]], by: str) -> Figure | None:
    """Regret per step while learning, over all worlds, against `frames` or `seconds`."""
    averaged = {method: _averaged(study, method, points, by) for method in study.methods}
    found = {method: curve for method, curve in averaged.items() if curve is not None}
    if not found:
        return None
    looks = looks_of(study.methods)
    unit = {"frames": "env steps", "seconds": "wall seconds of learning"}[by]

    def paint(figure: Canvas) -> None:
        axes = figure.subplots()
        for method, (grid, row) in found.items():
            style = looks[method]
            mean = np.maximum([e.mean for e in row], FLOOR)
            # A marker at every sixth position, so that curves are told apart without colours as well.
            axes.plot(grid, mean, label=method, markevery=6, **style.of_line())
            ends = [(e.mean if e.low is None else e.low, e.mean if e.high is None else e.high) for e in row]
            # `.T` gives the two rows, lower and upper ends.
            axes.fill_between(grid, *np.maximum(ends, FLOOR).T, color=style.colour, alpha=0.18, linewidth=0)
        # Both logarithmic: methods differ in steps and in regret by factors of ten and more.
        axes.set(xscale="log", yscale="log", xlabel=unit, ylabel="regret per step")
        tidy(axes)
        label_lines(figure, [axes], first=list(found))

    columns = [Column("method"), Column(unit, 1 if by == "seconds" else 0)]
    columns += [*estimate_columns("regret per step", 5), Column("n")]
    rows = [
        [method, float(grid[place]), *estimate_cells(row[place]), row[place].n]
        for method, (grid, row) in found.items()
        # Every third position: neighbours on the grid hardly differ.
        for place in range(0, len(grid), 3)
    ]
    counts = ", ".join(f"{method} n = {row[0].n}" for method, (_, row) in found.items())
    title = f"Regret while learning against {unit}: mean over worlds and seeds with 95 % interval; {counts}"
    ends = ", ".join(f"{m} {row[-1].mean:.4f} after {grid[-1]:,.0f}" for m, (grid, row) in found.items())
    table = Table(f"learning-{by}", title, columns, rows)
    return draw_figure(f"learning-{by}", title, f"Regret per step at the end: {ends} {unit}.", table, 3.3, paint)


def _averaged(
    study: Study, method: str, points: Mapping[str, Sequence[CurvePoint]], by: str
) -> tuple[Array, list[MeanInterval]] | None:
    """Positions `[G]` and the estimates there over all runs of a method; None where no curve is known.

    The positions begin where every run has been judged, and end with the longest.
    """
    groups = [[_steps(study, run, world, points, by) for run in study.of(world, method)] for world in study.worlds]
    known = [[curve for curve in group if len(curve)] for group in groups]
    everything = [curve for group in known for curve in group]
    if not everything:
        return None
    # From the latest of all first points: before it some runs have no value, and the mean would be over others.
    start, end = (float(max(curve[place, 0] for curve in everything)) for place in (0, -1))
    # 40 positions, evenly spaced on the logarithmic axis; `1.001` keeps a curve of one point from an empty range.
    grid = np.geomspace(max(start, 1e-2), max(end, start * 1.001), 40)
    # `[world][run]` -> `[G]`; a run that has ended keeps its last value, as its policy does not change any more.
    values = [[np.array([value_at(curve, x) for x in grid]) for curve in group] for group in known]
    return grid, [mean_over_groups([[v[i] for v in g] for g in values]) for i in range(len(grid))]


def profiles(study: Study, threshold: float | None) -> Figure | None:
    """The share of runs whose regret is at most τ; a line at the `threshold`."""
    pooled = {m: np.array([r for world in study.worlds for r in study.regrets(world, m)]) for m in study.methods}
    regrets = {method: values for method, values in pooled.items() if len(values)}
    if not regrets:
        return None
    # Up to a little above the worst run, so that every profile is seen to reach 1.
    levels = np.geomspace(1e-4, max(1.0, 1.05 * max(values.max() for values in regrets.values())), 60)
    found = {m: [share(int((values <= level).sum()), len(values)) for level in levels] for m, values in regrets.items()}

    looks = looks_of(study.methods)

    def paint(figure: Canvas) -> None:
        axes = figure.subplots()
        for method, row in found.items():
            style = looks[method]
            axes.plot(levels, [e.mean for e in row], style.line, color=style.colour, label=method)
            if row[0].low is not None:
                # Clopper-Pearson intervals, one for each level: no joint band of the whole curve.
                low, high = [e.low or 0.0 for e in row], [e.high or 0.0 for e in row]
                axes.fill_between(levels, low, high, color=style.colour, alpha=0.18, linewidth=0)
        if threshold is not None:
            axes.axvline(threshold, color=INK, linewidth=0.6, linestyle=(0, (1, 2)))
        axes.set(xscale="log", ylim=(-0.02, 1.02))
        axes.set(xlabel="τ, regret per step", ylabel="share of runs with regret ≤ τ")
        tidy(axes)
        legend(figure, axes, columns=2)  # all profiles end at 1: there is no end to write a name at

    counts = ", ".join(f"{method} n = {len(values)}" for method, values in regrets.items())
    title = f"Performance profiles: share of runs whose regret per step is at most τ, with 95 % interval; {counts}"
    marks = (0.001, 0.005, 0.01, 0.02, 0.05, 0.1)
    columns = [Column("method"), Column("n"), *(Column(f"≤ {mark:g}", 2) for mark in marks)]
    rows: list[list[Cell]] = [[m, len(v), *(float((v <= mark).mean()) for mark in marks)] for m, v in regrets.items()]
    said = [f"{m}: half of the runs at most {np.median(v):.4f}, all at most {v.max():.4f}" for m, v in regrets.items()]
    return draw_figure("profiles", title, "; ".join(said) + ".", Table("profiles", title, columns, rows), 3.3, paint)


def _steps(study: Study, run: FinishedRun, world: str, curves: Mapping[str, Sequence[CurvePoint]], by: str) -> Array:
    """`[points, 2]` position and regret of one run; of several points at one position the last counts."""
    if math.isnan(study.upper(world)):
        return np.zeros((0, 2))
    # Seconds are rounded, so that several points may fall on one; of a dict's entries the last one stays.
    last = {float(getattr(p, by)): study.regret(run, world, p.aihtr) for p in curves.get(run.name, ())}
    return np.array(sorted(last.items()))


def value_at(curve: Array, x: float) -> float:
    """The regret of the last policy judged at or before x; before the first, the first's."""
    # A step function: what was valued last is what the learner has. 1e-9: the grid's ends are powers, and may fall
    # just short of the point they were made from.
    place = int(np.searchsorted(curve[:, 0], x * (1 + 1e-9), side="right")) - 1
    return float(curve[max(place, 0), 1])
