"""Figures of what was learned: AIHTR and regret against the price of a sensor, learning curves, profiles."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from trackmdp.reports.grouping import Study
from trackmdp.reports.labels import label_lines
from trackmdp.reports.results import CurvePoint, FinishedRun
from trackmdp.reports.style import INK, LOOKS, PAGE, Axes, Canvas, Figure, Look, draw_figure, looks_of, tidy
from trackmdp.reports.summaries import estimate_cells, estimate_columns
from trackmdp.reports.tables import Cell, Column, Table
from trackmdp.statistics import MeanInterval, mean_over_groups, share
from trackmdp.world.model import Array

# A policy may attain the bound itself, and zero has no logarithm: such a regret is drawn here.
FLOOR = 1e-5
"""Smallest regret drawn on a logarithmic axis."""
PRICE = "c, price of a sensor for one step"
BOUNDS = {
    "printed bound": "bound_paper",
    "valid bound": "bound_valid",
    "clocked bound": "bound_clocked",
    "optimum": "optimal_lower",
}


@dataclass(frozen=True)
class Panel:
    """One figure's worlds: the same but for the price of a sensor, which rises."""

    name: str
    title: str
    costs: Sequence[float]
    worlds: Sequence[str]


def panels(study: Study) -> list[Panel]:
    """Worlds that differ in `cost.sensor` only, at least two of them to a panel."""
    groups: dict[str, list[tuple[float, str]]] = {}
    for world in study.worlds:
        price = study.in_world(world)[0].settings.get("cost.sensor")
        if isinstance(price, (int, float)):
            # The label without its price is what the worlds of one panel share, and is their title.
            rest = ", ".join(part for part in world.split(", ") if not part.startswith("c="))
            groups.setdefault(rest, []).append((float(price), world))
    # One price is a point, not a curve; the tables show it.
    found = {title: dict(sorted(entries)) for title, entries in groups.items() if len(entries) > 1}
    return [Panel(slug(title), title, list(priced), list(priced.values())) for title, priced in found.items()]


def against_cost(study: Study, panel: Panel) -> Figure:
    """AIHTR against c: the learned policies with their intervals, Q_MDP, the bounds, the optimum."""
    # None depends on the run: of those found the best is taken.
    keys = {"Q_MDP": "qmdp_aihtr"} | BOUNDS
    exact = {name: [max(study.known(w, key), default=math.nan) for w in panel.worlds] for name, key in keys.items()}
    # A bound that no run has, as where no optimum was solved for, gets no empty entry in the legend.
    exact = {label: values for label, values in exact.items() if not all(map(math.isnan, values))}
    drawn = _Against.of(study, panel, exact, lambda *pair: [run.figure("aihtr") for run in study.of(*pair)])
    learned = [[e.mean for e in row] for row in drawn.learned.values()]
    # Q_MDP falls far below 0 where only the safe action senses (Z = 5, c = 0.22); on one axis the learned policies
    # would become one line.
    split = axis_break(list(zip(*learned, *exact.values(), strict=True)))

    def paint(figure: Canvas) -> None:
        # The upper part, where the methods differ, gets four fifths of the height.
        split_axes = figure.subplots(2, 1, sharex=True, height_ratios=[4, 1]) if split else [figure.subplots()]
        for axes in split_axes:
            drawn.learned_lines(axes)
            for label, values in exact.items():
                axes.plot(panel.costs, values, label=label, lw=1.1, **LOOKS[label].of_line())
            tidy(axes)
        if split:
            _break(split_axes[0], split_axes[1], *split)
        split_axes[0].set_ylabel("AIHTR")
        # Ticks at the prices that were run: between them nothing was measured.
        split_axes[-1].set(xlabel=PRICE, xticks=panel.costs)
        label_lines(figure, split_axes, first=list(drawn.learned))

    table = drawn.table("aihtr", "AIHTR", digits=3)
    text = drawn.spoken(digits=1) + (" The axis is broken between the groups of values." if split else "")
    return draw_figure(drawn.titled("AIHTR against the price of a sensor"), text, table, 3.9, paint)


def regret_against_cost(study: Study, panel: Panel, threshold: float | None) -> Figure:
    """Regret per step against c, logarithmic, so that the best are told apart; a line at the `threshold`."""
    first = {world: study.in_world(world)[0] for world in panel.worlds}
    exact = {"Q_MDP": [study.regret(run, world, run.figure("qmdp_aihtr")) for world, run in first.items()]}
    drawn = _Against.of(study, panel, exact, study.regrets)

    def paint(figure: Canvas) -> None:
        axes = figure.subplots()
        # Interval ends are cut at the floor as well: one at or below zero would vanish from a logarithmic axis.
        drawn.learned_lines(axes, floor=FLOOR)
        axes.plot(panel.costs, np.maximum(exact["Q_MDP"], FLOOR), label="Q_MDP", **LOOKS["Q_MDP"].of_line())
        if threshold is not None:
            axes.axhline(threshold, color=INK, linewidth=0.6, linestyle=(0, (1, 2)), zorder=1)
            at, where = (0.01, threshold), ("axes fraction", "data")
            # x in parts of the axes, y in data: on the left, on the line; the names of the lines stand on the right.
            free = {"facecolor": PAGE, "edgecolor": "none", "pad": 0.4}
            axes.annotate(f"{threshold:g}", at, xycoords=where, va="center", bbox=free, zorder=1)
        axes.set(yscale="log", ylabel="regret per step", xlabel=PRICE, xticks=panel.costs)
        tidy(axes)
        label_lines(figure, [axes], first=list(drawn.learned))

    table = drawn.table("regret", "regret per step", digits=5)
    title = drawn.titled("Regret per step to the proved upper bound")
    return draw_figure(title, drawn.spoken(digits=4), table, 3.4, paint)


@dataclass(frozen=True)
class _Against:
    """What is drawn against the price of a sensor.

    Attributes:
        panel: the worlds.
        looks: of each method.
        learned: method -> its estimate in each world.
        exact: policy or bound -> its value in each world.
    """

    panel: Panel
    looks: Mapping[str, Look]
    learned: Mapping[str, Sequence[MeanInterval]]
    exact: Mapping[str, Sequence[float]]

    @classmethod
    def of(
        cls, study: Study, panel: Panel, exact: Mapping[str, Sequence[float]], values: Callable[..., Sequence[float]]
    ) -> _Against:
        """What `values` gives of each (world, method) of a study, beside `exact`."""
        found = {}
        for method in study.methods:
            groups = [values(world, method) for world in panel.worlds]
            if any(groups):
                found[method] = [mean_over_groups([group]) for group in groups]
        return cls(panel, looks_of(study.methods), found, exact)

    def learned_lines(self, axes: Axes, floor: float = -math.inf) -> None:
        """Lines with error bars, a little apart so that the bars can be told from each other."""
        # 4 % of the smallest distance of two prices: error bars stand side by side, and still over their price.
        step = min(np.diff(self.panel.costs), default=0.02) * 0.04
        for place, (method, row) in enumerate(self.learned.items()):
            x = np.asarray(self.panel.costs) + step * (place - (len(self.learned) - 1) / 2)
            mean, low, high = _drawn(row, floor)
            # `[2, prices]`, lengths below and above the mean; matplotlib refuses negative ones, which rounding would
            # make.
            bars = np.stack([np.maximum(mean - low, 0), np.maximum(high - mean, 0)])
            axes.errorbar(x, mean, bars, capsize=2, elinewidth=0.9, label=method, **self.looks[method].of_line())

    def table(self, kind: str, label: str, digits: int) -> Table:
        """The numbers."""
        rows: list[list[Cell]] = []
        for place, cost in enumerate(self.panel.costs):
            # Where a method has no run at a price it gets no row; n = 0 would be read as a result.
            some = {method: row[place] for method, row in self.learned.items() if row[place].n}
            rows += [[cost, method, *estimate_cells(found), found.n] for method, found in some.items()]
            rows += [[cost, name, values[place], None, None, None] for name, values in self.exact.items()]
        columns = [Column("c", 2), Column("policy or bound"), *estimate_columns(label, digits), Column("n")]
        caption = f"{label} by price, {self.panel.title}: mean over seeds"
        return Table(f"{kind}-{self.panel.name}", caption, columns, rows)

    def spoken(self, digits: int) -> str:
        """The values of every line, in words."""
        lines = {method: [e.mean for e in row] for method, row in self.learned.items()} | dict(self.exact)
        costs = ", ".join(f"{cost:g}" for cost in self.panel.costs)
        said = [f"{name}: {', '.join(f'{v:.{digits}f}' for v in values)}" for name, values in lines.items()]
        return f"At c = {costs}. {'; '.join(said)}."

    def titled(self, what: str) -> str:
        """The title: what it shows, where, and how many runs stand behind a point, as in `ppo n = 2–5`."""
        counts = {method: sorted({e.n for e in row if e.n}) for method, row in self.learned.items()}
        seeds = ", ".join(f"{m} n = {'–'.join(map(str, (c[0], c[-1])[: len(c)]))}" for m, c in counts.items())
        return f"{what}, {self.panel.title}; seeds per point: {seeds}"


def _drawn(row: Sequence[MeanInterval], floor: float) -> Array:
    """`[3, K]` the means, the lower and the upper ends of some estimates, none below `floor`."""
    # No interval (fewer than three seeds): a bar of length zero, which is only the point.
    ends = [(e.mean, e.mean if e.low is None else e.low, e.mean if e.high is None else e.high) for e in row]
    return np.maximum(ends, floor).T


def axis_break(prices: Sequence[Sequence[float]]) -> tuple[float, float, float, float] | None:
    """Where to break the axis: (lowest, end of the lower part, start of the upper one, highest), None if nowhere.

    It breaks where the widest gap between neighbouring values takes more than half of the axis, unless all values of
    one of the `prices` lie below: then every line would be cut.
    """
    # nan, where a method was not run at a price, is no value to make room for.
    known = [[value for value in values if math.isfinite(value)] for values in prices]
    ordered = np.sort([value for values in known for value in values])
    if len(ordered) < 3:
        return None
    gaps = np.diff(ordered)
    widest = int(gaps.argmax())
    # Breaking an axis hides proportions; it is done only where one gap would take more room than all the values.
    if gaps[widest] <= 0.5 * (ordered[-1] - ordered[0]):
        return None
    if any(max(values) < ordered[widest + 1] for values in known if values):
        return None
    return float(ordered[0]), float(ordered[widest]), float(ordered[widest + 1]), float(ordered[-1])


def _break(upper: Axes, lower: Axes, bottom: float, lower_end: float, upper_start: float, top: float) -> None:
    # `or 1.0`: all values of the upper part may be one and the same.
    margin = 0.08 * (top - upper_start or 1.0)
    upper.set_ylim(upper_start - margin, top + margin)
    small = max(0.25 * (lower_end - bottom), margin)
    lower.set_ylim(bottom - small, lower_end + small)
    lower.locator_params(axis="y", nbins=2, integer=True)
    upper.spines["bottom"].set_visible(False)
    upper.tick_params(bottom=False)
    # Short slanted strokes at both ends of the gap, the usual sign of a broken axis; `transAxes` puts them at the
    # corners.
    marks = {"marker": [(-1, -0.6), (1, 0.6)], "markersize": 7, "linestyle": "none", "color": INK, "clip_on": False}
    upper.plot([0], [0], transform=upper.transAxes, **marks)  # type: ignore[arg-type]
    lower.plot([0], [1], transform=lower.transAxes, **marks)  # type: ignore[arg-type]


def slug(title: str) -> str:
    """A title as part of a file's name, of which systems take 255 bytes."""
    letters = "".join(character if character.isalnum() else "-" for character in title.lower())
    kept = "-".join(part for part in letters.split("-") if part) or "all"
    if len(kept.encode()) <= 200:
        return kept
    return f"{kept[:40]}-{hashlib.sha256(title.encode()).hexdigest()[:8]}"  # a letter has four bytes at most


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
            mean, low, high = _drawn(row, FLOOR)
            # A marker at every sixth position, so that curves are told apart without colours as well.
            axes.plot(grid, mean, label=method, markevery=6, **style.of_line())
            axes.fill_between(grid, low, high, color=style.colour, alpha=0.18, linewidth=0)
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
    return draw_figure(title, f"Regret per step at the end: {ends} {unit}.", table, 3.3, paint)


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
    if end <= (start := max(start, 1e-2)):
        return None  # judged once, as what learns from one batch is: a point is no curve
    # 40 positions, evenly spaced on the logarithmic axis
    grid = np.geomspace(start, end, 40)
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
        # All end at 1: names stand right of the lines, each at a height of its own, that of the best one on top.
        best = sorted(found, key=lambda method: float(np.median(regrets[method])))
        for place, method in enumerate(best):
            height = max(1 - (place + 0.5) / len(best), found[method][0].mean)
            risen = next(level for level, e in zip(levels, found[method], strict=True) if e.mean >= height)
            colour = looks[method].colour
            axes.annotate(method, (risen, height), (6, 0), textcoords="offset points", va="center", color=colour)

    counts = ", ".join(f"{method} n = {len(values)}" for method, values in regrets.items())
    title = f"Performance profiles: share of runs whose regret per step is at most τ, with 95 % interval; {counts}"
    marks = (0.001, 0.005, 0.01, 0.02, 0.05, 0.1)
    columns = [Column("method"), Column("n"), *(Column(f"≤ {mark:g}", 2) for mark in marks)]
    rows: list[list[Cell]] = [[m, len(v), *(float((v <= mark).mean()) for mark in marks)] for m, v in regrets.items()]
    said = [f"{m}: half of the runs at most {np.median(v):.4f}, all at most {v.max():.4f}" for m, v in regrets.items()]
    return draw_figure(title, "; ".join(said) + ".", Table("profiles", title, columns, rows), 3.3, paint)


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
