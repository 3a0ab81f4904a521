"""Figures of learned policies: against the price of a sensor, while learning, and the spread over runs."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from trackmdp.arrays.types import Array
from trackmdp.notebook.card import counted_words
from trackmdp.reports.grouping import Study
from trackmdp.reports.style import (
    INK,
    REFERENCES,
    Axes,
    Canvas,
    Figure,
    Look,
    draw_figure,
    legend,
    looks_of,
    tidy,
)
from trackmdp.reports.tables import Column, Rows, Table, interval_columns
from trackmdp.reports.ticks import label_values
from trackmdp.statistics import MeanInterval, mean_over_groups, share

# A policy may attain the bound, and zero has no logarithm.
FLOOR = 1e-5
"""Smallest regret drawn on a logarithmic axis."""
QUANTITIES = {
    "regret": Column("regret per step", 5),
    "aihtr": Column("AIHTR", 3),
    "accuracy": Column("accuracy", 4),
    "sensors_per_step": Column("sensors per step", 3),
}
"""Figures of policies that are drawn against the price of a sensor."""


@dataclass(frozen=True)
class Line:
    """A line of a figure: estimates at some positions; `n` is 0 in an estimate that is exact."""

    name: str
    look: Look
    x: Sequence[float]
    row: Sequence[MeanInterval]


def _line_figure(
    name: str,
    title: str,
    lines: Sequence[Line],
    heads: tuple[Column, Column],
    finish: Callable[[Axes], None],
    *,
    floor: float = -math.inf,
    shift: float = 0.0,
    thin: int = 1,
) -> Figure:
    """Lines with bands of their intervals, and a table of their values.

    Args:
        name: of the files.
        title: caption.
        lines: of the figure.
        heads: columns of positions and of estimates.
        finish: sets scales, limits and further marks.
        floor: smaller values are drawn there.
        shift: distance between equal positions of neighbouring learned lines, the first ones, so that lines that
            coincide are seen.
        thin: a marker, and a row of the table, at every so many positions.
    """

    def paint(figure: Canvas) -> None:
        axes = figure.subplots()
        learned = sum(any(each.n for each in line.row) for line in lines)
        for place, line in enumerate(lines):
            # Around the true position, where exact lines stand: three are shifted by -1, 0 and 1 times `shift`.
            moved = shift * (place - (learned - 1) / 2) if place < learned else 0.0
            x = np.asarray(line.x) + moved
            # `[3, K]`; without an interval, None, its ends are the mean.
            ends = np.array([(each.mean, each.low, each.high) for each in line.row], float).T
            mean, low, high = np.maximum(np.where(np.isnan(ends), ends[0], ends), floor)
            marks = (2 * place % thin, thin) if thin > 1 else None
            axes.plot(x, mean, label=line.name, markevery=marks, **vars(line.look))
            axes.fill_between(x, low, high, color=line.look.color, alpha=0.18, linewidth=0)
        axes.set(xlabel=heads[0].label, ylabel=heads[1].label)
        finish(axes)
        tidy(axes)
        legend(figure, axes)

    columns = [Column("line"), *heads, *interval_columns(heads[1].digits), Column("n")]
    rows: Rows = [
        [line.name, float(x), each.mean, each.low, each.high, each.n or None]
        for line in lines
        for x, each in [*zip(line.x, line.row, strict=True)][::thin]
    ]
    return draw_figure(Table(name, title, columns, rows), 3.4, paint)


def _count(lines: Sequence[Line], unit: str) -> str:
    """The number of runs of an estimate: ``n = 1 seed``, ``n = 3 seeds``, or ``n = 2–5 seeds``."""
    counts = sorted({each.n for line in lines for each in line.row if each.n})
    fewest = "" if counts[0] == counts[-1] else f"{counts[0]}–"
    return f"n = {fewest}{counted_words(counts[-1], unit)}"


Panel: TypeAlias = tuple[str, dict[float, str]]
"""A title, and price of a sensor, rising -> world: worlds that are the same but for that price."""


def panels(study: Study) -> list[Panel]:
    """Panels of at least two worlds."""
    groups: dict[str, dict[float, str]] = {}
    for world in study.worlds:
        price = study.of(world)[0].settings.get("cost.sensor")
        if isinstance(price, (int, float)):
            # The worlds of a panel share the label without its price; a name may have a later part like it.
            parts = world.split(", ")
            parts.remove(next(part for part in parts if part.startswith("c=")))
            groups.setdefault(", ".join(parts), {})[float(price)] = world
    return [
        (title, dict(sorted(priced.items()))) for title, priced in groups.items() if len(priced) > 1
    ]


_PLAIN = re.compile(r"([\w.]+(=[a-z\d_.]+)?(, |$))+")
"""A title of choices and numbers."""


def slug(title: str) -> str:
    """A title as part of a file name, of which systems take 255 bytes; titles that differ have names that differ."""
    letters = "".join(each if each.isalnum() else "-" for each in title.lower())
    kept = "-".join(filter(None, letters.split("-")))
    if len(kept.encode()) > 200:
        kept = kept[:40]
    elif _PLAIN.fullmatch(title):
        return kept
    # Capitals and signs are lost, as of path=A.npy and path=a.npy, or origin=-1x2 and origin=1x2.
    return f"{kept}-{hashlib.sha256(title.encode()).hexdigest()[:8]}"


def against_price(study: Study, panel: Panel, key: str, threshold: float | None) -> Figure | None:
    """One of `QUANTITIES` against c: learned policies, others, bounds; None where no run has it.

    The regret is drawn on a logarithmic axis, with a line at the `threshold`.
    """
    title, worlds = panel
    costs = [*worlds]
    learned = [
        Line(method, look, costs, [mean_over_groups([group]) for group in groups])
        for method, look in looks_of(study.methods).items()
        if any(groups := [study.values(world, method, key) for world in worlds.values()])
    ]
    if not learned:
        return None
    others = []
    for name in filter(REFERENCES.__contains__, study.references()):
        row = [study.reference(world, name, key) for world in worlds.values()]
        if np.isfinite(row).all() and (key != "regret" or name in ("Q_MDP", "all on")):
            exact = [MeanInterval(value, None, None, 0) for value in row]
            others.append(Line(study.title(name), REFERENCES[name], costs, exact))

    def finish(axes: Axes) -> None:
        if key != "regret":
            axes.set_ylim(limits := _limits(learned, others))
            for drawn in axes.lines:
                heights = np.asarray(drawn.get_ydata())
                if heights.max() < limits[0] or heights.min() > limits[1]:
                    drawn.set_label(f"_{drawn.get_label()}")  # out of sight: not in the legend
        else:
            axes.set_yscale("log")
            if threshold is not None:
                axes.axhline(threshold, color=INK, linewidth=0.6, linestyle=":")
        label_values(axes, costs)

    column = QUANTITIES[key]
    return _line_figure(
        f"{key.replace('_', '-')}-{slug(title)}",
        f"{column.label[0].upper()}{column.label[1:]} by the price of a sensor, {title}; {_count(learned, 'seed')}",
        [*learned, *others],
        (Column("c, price of a sensor for one step"), column),
        finish,
        floor=FLOOR if key == "regret" else -math.inf,
        shift=0.03 * float(np.diff(costs).min()) / len(learned),
    )


def _limits(learned: Sequence[Line], others: Sequence[Line]) -> tuple[float, float]:
    """Limits of an axis: around the best policy known, and down to learned ones up to three times its range below it.

    Other policies may lie far away: all sensors on earns thousands less. They are drawn as far as they are in sight.
    """
    near = [line for line in others if line.look == REFERENCES["best known"]] or learned
    best, every = (
        np.array([each.mean for line in lines for each in line.row if math.isfinite(each.mean)])
        for lines in (near, [*near, *learned])
    )
    low, high = max(every.min(), best.min() - 3 * (np.ptp(best) or 1.0)), every.max()
    margin = 0.1 * (high - low or 1.0)
    return low - margin, high + margin


def learning(study: Study, by: str) -> Figure | None:
    """Regret per step while learning against `frames` or `seconds`, over all worlds; None without a curve."""
    place, late = ("frames", "seconds").index(by), late_learners(study)
    lines = [
        _mean_curve(method, look, groups)
        for method, look in looks_of(study.methods).items()
        if method not in late and (groups := _curves(study, method, place))
    ]
    if not lines:
        return None
    title = f"Regret while learning: mean over worlds and seeds with 95 % interval; {_count(lines, 'run')}"
    heads = (Column(("env steps", "seconds of learning")[place], 1), QUANTITIES["regret"])

    def finish(axes: Axes) -> None:
        axes.set(xscale="log", yscale="log")

    return _line_figure(f"learning-{by}", title, lines, heads, finish, floor=FLOOR, thin=6)


def late_learners(study: Study) -> dict[str, float]:
    """Methods without a curve, which learn at the end of a run, and their env steps.

    Their regret falls by less than a tenth before the last evaluation, which is below half of the first.
    """
    found = {}
    for method in study.methods:
        curves = [curve[:, 1] for group in _curves(study, method, 0) for curve in group]
        flat = [len(y) < 3 or (y[-2] > 0.9 * y[0] and y[-1] < 0.5 * y[0]) for y in curves]
        if curves and all(flat):
            found[method] = max(run.figure("frames") for run in study.of(method=method))
    return found


def _curves(study: Study, method: str, place: int) -> list[list[Array]]:
    """By world, of each run `[points, 2]`: position (0 frames, 1 seconds) and regret."""
    groups = []
    for world in study.worlds:
        # Of several points at one position, rounded seconds, the last one stays.
        found = [
            {point[place]: study.regret(run, world, point[2]) for point in run.curve}
            for run in study.of(world, method)
            if math.isfinite(study.upper(world))
        ]
        groups.append([np.array(sorted(each.items())) for each in found if each])
    return [group for group in groups if group]


def _mean_curve(method: str, look: Look, groups: Sequence[Sequence[Array]]) -> Line:
    """The mean of curves, from the latest first point of all to the last point."""
    # Before the latest first point some runs have no value.
    start, end = (max(curve[at, 0] for group in groups for curve in group) for at in (0, -1))
    grid = np.geomspace(max(start, 1e-2), max(end, 2e-2), 40)
    values = [np.array([values_at(curve, grid) for curve in group]) for group in groups]
    row = [mean_over_groups([each[:, i].tolist() for each in values]) for i in range(len(grid))]
    return Line(method, look, grid.tolist(), row)


def values_at(curve: Array, grid: Array) -> Array:
    """`[G]` regret of the last evaluation at or before each position; before the first, the regret of the first."""
    # The ends of the grid are powers, which may fall just short of a point.
    places = np.searchsorted(curve[:, 0], grid * (1 + 1e-9), side="right") - 1
    return curve[np.maximum(places, 0), 1]  # before the first evaluation the place is -1


def profiles(study: Study, threshold: float | None) -> Figure | None:
    """Share of runs with a regret of at most τ, with a line at the `threshold`."""
    regrets = {
        method: np.concatenate(each) for method in study.methods if (each := study.regrets(method))
    }
    if not regrets:
        return None
    # A little above the worst run: every profile reaches 1.
    levels = np.geomspace(1e-4, max(1.0, 1.05 * max(map(np.max, regrets.values()))), 60)
    lines = [
        Line(
            method,
            looks_of(study.methods)[method],
            levels.tolist(),
            [share(int((values <= level).sum()), len(values)) for level in levels],
        )
        for method, values in regrets.items()
    ]

    def finish(axes: Axes) -> None:
        axes.set(xscale="log")
        if threshold is not None:
            axes.axvline(threshold, color=INK, linewidth=0.6, linestyle=":")

    title = f"Share of runs with a regret per step of at most τ, with 95 % interval; {_count(lines, 'run')}"
    heads = (Column("τ, regret per step", 5), Column("share of runs", 2))
    return _line_figure("profiles", title, lines, heads, finish, thin=12)
