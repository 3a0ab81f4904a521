"""Figures and tables on the paper's unstated settings: the kernels chosen, and the sensitivity of the results."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import astuple
from typing import Any

import numpy as np

from trackmdp.paper.calibration import DRAWS, Candidate, Setting, Spread, chosen
from trackmdp.paper.worlds import COSTS, PRINTED_QMDP, SUPPORTS
from trackmdp.reports.style import INK, LOOKS, Canvas, Figure, draw_figure, legend, tidy
from trackmdp.reports.tables import Cell, Column, Table

# One colour per Z through all figures of this part; they are those of methods, which do not occur here.
COLOURS = {3: LOOKS["a2c"], 4: LOOKS["ppo"], 5: LOOKS["hindsight"]}


def candidates_table(every: Sequence[Candidate]) -> Table:
    """All candidates of all Z, the best first."""
    seeds = chosen(every)
    columns = [Column("Z"), Column("seed"), Column("deviation", 2, "points")]
    columns += [Column(f"accuracy at c = {cost:g}", 2, "%") for cost in COSTS]
    ordered = sorted(every, key=lambda c: (c.support_size, c.deviation, c.seed))
    rows = [[c.support_size, c.seed, c.deviation, *c.accuracy, seeds[c.support_size] == c.seed] for c in ordered]
    return Table("calibration", f"All {len(rows)} candidate kernels", [*columns, Column("chosen")], rows)


def calibration_figure(every: Sequence[Candidate]) -> Figure:
    """Every candidate's deviation, the chosen one marked."""
    seeds = chosen(every)

    def paint(figure: Canvas) -> None:
        axes = figure.subplots()
        for support_size, style in COLOURS.items():
            mine = sorted((c for c in every if c.support_size == support_size), key=lambda c: c.seed)
            # One band per Z; within it the seed is the height, only to keep the dots apart.
            height = [support_size + 0.6 * (c.seed / len(mine) - 0.5) for c in mine]
            axes.plot([c.deviation for c in mine], height, ".", color=style.colour, markersize=4, alpha=0.7)
            best = next(c for c in mine if c.seed == seeds[support_size])
            place = support_size + 0.6 * (best.seed / len(mine) - 0.5)
            axes.plot([best.deviation], [place], "o", color=INK, markersize=8, markerfacecolor="none")
            # To the left: the chosen one is the leftmost of its band, so that the label meets no other dot.
            label, at = f"seed {best.seed}", (best.deviation, place)
            axes.annotate(label, at, (-8, 0), textcoords="offset points", ha="right", va="center")
        # Deviations differ by factors, and the choice is among the smallest.
        axes.set(xscale="log", xlabel="largest deviation from the printed accuracy (points)")
        # Room for the labels on the left.
        axes.margins(x=0.4)
        axes.set_yticks(list(COLOURS), [f"Z = {support_size}" for support_size in COLOURS])
        tidy(axes)

    title = f"Candidate kernels by their distance to the printed Q_MDP accuracy, n = {len(every) // 3} for each Z"
    best = {c.support_size: c for c in every if seeds[c.support_size] == c.seed}
    text = "; ".join(f"Z = {z}: seed {c.seed}, {c.deviation:.2f} points" for z, c in sorted(best.items()))
    return draw_figure("calibration", title, f"Chosen, {text}.", candidates_table(every), 2.8, paint)


def fit_table(settings: Sequence[Setting]) -> Table:
    """How well the best draw of each setting fits the printed column."""
    fits: dict[tuple[str, int], dict[int, float]] = {}
    for setting in settings:
        # `deviation` covers all prices, so the settings of one Z that differ in c write the same number.
        fits.setdefault((setting.border, setting.t_max), {})[setting.support_size] = setting.deviation
    ordered = sorted(fits.items(), key=lambda item: max(item[1].values()))
    rows: list[list[Cell]] = [[*setting, *(fit[z] for z in SUPPORTS), max(fit.values())] for setting, fit in ordered]
    columns = [Column("border"), Column("T_max"), *(Column(f"Z = {z}", 2, "points") for z in SUPPORTS)]
    caption = f"Smallest deviation from the printed Q_MDP accuracy among {len(DRAWS)} draws, by setting"
    return Table("fit", caption, [*columns, Column("worst of the three", 2, "points")], rows)


def sensitivity_table(settings: Sequence[Setting]) -> Table:
    """Median and range over draws of three figures, for every setting and pair."""
    columns = [Column("border"), Column("T_max"), Column("Z"), Column("c", 2)]
    for label, digits in (("Q_MDP accuracy %", 2), ("Q_MDP AIHTR", 1), ("clocked bound AIHTR", 1)):
        columns += [Column(f"{label}, median", digits), Column("low", digits), Column("high", digits)]
    rows = [
        [s.border, s.t_max, s.support_size, s.cost, *astuple(s.accuracy), *astuple(s.qmdp), *astuple(s.clocked)]
        for s in settings
    ]
    return Table(
        "sensitivity", f"Median and range over {len(DRAWS)} draws of the kernel, by setting and pair", columns, rows
    )


def sensitivity_figures(settings: Sequence[Setting]) -> list[Figure]:
    """Accuracy of Q_MDP, its AIHTR and the clocked bound under each setting, at the lowest price."""
    # At the lowest price all probabilities but 0.15 exceed c/r, and Table II prints one accuracy for three prices.
    cost = COSTS[0]
    mine = [setting for setting in settings if setting.cost == cost]
    return [
        _ranges("accuracy", "Accuracy of Q_MDP (%)", mine, lambda s: s.accuracy, printed=True),
        _ranges("qmdp", "AIHTR of Q_MDP", mine, lambda s: s.qmdp),
        _ranges("clocked", "AIHTR of the clocked bound", mine, lambda s: s.clocked),
    ]


def _ranges(
    name: str, label: str, settings: Sequence[Setting], of: Callable[[Setting], Spread], *, printed: bool = False
) -> Figure:
    rows = list(dict.fromkeys((s.border, s.t_max) for s in settings))

    def paint(figure: Canvas) -> None:
        axes = figure.subplots()
        # The three Z of a setting stand in one row, a little apart.
        for offset, support_size in zip((-0.24, 0.0, 0.24), COLOURS, strict=True):
            look = COLOURS[support_size]
            middle, low, high = np.array([astuple(of(s)) for s in settings if s.support_size == support_size]).T
            # `[2, settings]`, lengths below and above the median. The range, not a confidence interval: how far the
            # draw of the kernel moves a figure.
            bars, y = np.stack([middle - low, high - middle]), np.arange(len(rows)) + offset
            points: Any = {"fmt": look.marker, "color": look.colour, "markersize": 3.5, "elinewidth": 1.2}
            axes.errorbar(middle, y, xerr=bars, label=f"Z = {support_size}", **points)
            if printed:
                axes.axvline(PRINTED_QMDP[support_size, COSTS[0]], color=look.colour, linewidth=0.8, linestyle=":")
        axes.set_yticks(range(len(rows)), [f"{border}, T_max {t_max}" for border, t_max in rows])
        # The first setting on top, as in the table.
        axes.invert_yaxis()
        axes.set_xlabel(label)
        tidy(axes)
        legend(figure, axes)

    under = f"under the paper's unstated settings, c = {settings[0].cost:g}"
    title = f"{label} {under}: median and range, n = {len(DRAWS)} draws"
    ends = [of(setting).median for setting in settings]
    text = f"Medians from {min(ends):.1f} to {max(ends):.1f}." + (" Dotted: the printed values." if printed else "")
    columns = [Column("border"), Column("T_max"), Column("Z"), Column("median", 2), Column("low", 2), Column("high", 2)]
    numbers: list[list[Cell]] = [[s.border, s.t_max, s.support_size, *astuple(of(s))] for s in settings]
    table = Table(f"sensitivity-{name}", title, columns, numbers)
    return draw_figure(f"sensitivity-{name}", title, text, table, 4.2, paint)
