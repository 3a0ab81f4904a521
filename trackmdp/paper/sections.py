"""The paper's part of a report: Table II beside exact accuracies, open settings, and where it is silent or wrong."""

from __future__ import annotations

import html
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from trackmdp.paper import calibration
from trackmdp.paper.calibration import DRAWS, Candidate, Openings, Setting, Spread, chosen
from trackmdp.paper.check import NO_CASE, Check
from trackmdp.paper.worlds import COSTS, PRINTED_QMDP, PRINTED_TMDP, SUPPORTS, Pairs, pairs
from trackmdp.reports.grouping import Study
from trackmdp.reports.page import Part, Section
from trackmdp.reports.style import INK, LOOKS, Canvas, Figure, draw_figure, legend, tidy
from trackmdp.reports.tables import Cell, Column, Rows, Table, paragraphs

# One colour per Z through all figures of this part; they are those of methods, which do not occur here.
COLOURS = dict(zip(SUPPORTS, (LOOKS[0], LOOKS[2], LOOKS[1]), strict=True))


def candidates_table(every: Sequence[Candidate]) -> Table:
    """All candidates of all Z, the best first."""
    seeds = chosen(every)
    columns = [Column("Z"), Column("seed"), Column("deviation", 2, "points")]
    columns += [Column(f"accuracy at c = {cost:g}", 2, "%") for cost in COSTS]
    columns.append(Column("chosen"))
    rows = [
        [c.support_size, c.seed, c.deviation, *c.accuracy, seeds[c.support_size] == c.seed]
        for c in every
    ]
    return Table("calibration", f"All {len(rows)} candidate kernels", columns, rows)


def calibration_figure(every: Sequence[Candidate]) -> Figure:
    """Every candidate's deviation, the chosen one marked."""

    def paint(figure: Canvas) -> None:
        axes = figure.subplots()
        for support_size, style in COLOURS.items():
            best, *_ = mine = [c for c in every if c.support_size == support_size]
            # One band per Z; within it the seed is the height, only to keep the dots apart.
            height = [support_size + 0.6 * (c.seed / len(mine) - 0.5) for c in mine]
            deviations = [c.deviation for c in mine]
            axes.plot(deviations, height, ".", color=style.color, markersize=4, alpha=0.7)
            at = deviations[0], height[0]
            axes.plot(*at, "o", color=INK, markersize=8, markerfacecolor="none")
            # To the left: the chosen one is the leftmost of its band, so that the label meets no other dot.
            label = f"seed {best.seed}"
            axes.annotate(label, at, (-8, 0), textcoords="offset points", ha="right", va="center")
        # Deviations differ by factors, and the choice is among the smallest.
        axes.set(xscale="log", xlabel="largest deviation from the printed accuracy (points)")
        # Room for the labels on the left.
        axes.margins(x=0.4)
        axes.set_yticks(list(COLOURS), [f"Z = {support_size}" for support_size in COLOURS])
        tidy(axes)

    title = f"Candidate kernels by their distance to the printed Q_MDP accuracy, n = {len(every) // 3} for each Z"
    return draw_figure(replace(candidates_table(every), caption=title), 2.8, paint)


def fit_table(settings: Sequence[Setting]) -> Table:
    """How well the best draw of each setting fits the printed column."""
    fits: dict[tuple[str, int], dict[int, float]] = {}
    for setting in settings:
        # `deviation` covers all prices, so the settings of one Z that differ in c write the same number.
        fit = fits.setdefault((setting.border, setting.t_max), {})
        fit[setting.support_size] = setting.deviation
    ordered = sorted(fits.items(), key=lambda item: max(item[1].values()))
    rows: Rows = [[*at, *(fit[z] for z in SUPPORTS), max(fit.values())] for at, fit in ordered]
    columns = [Column("border"), Column("T_max")]
    columns += [Column(f"Z = {z}", 2, "points") for z in SUPPORTS]
    caption = (
        f"Smallest deviation from the printed Q_MDP accuracy among {len(DRAWS)} draws, by setting"
    )
    return Table("fit", caption, [*columns, Column("worst of the three", 2, "points")], rows)


def sensitivity_table(settings: Sequence[Setting]) -> Table:
    """Median and range over draws of three figures, for every setting and pair."""
    columns = [Column("border"), Column("T_max"), Column("Z"), Column("c", 2)]
    for label, digits in (("Q_MDP accuracy %", 2), ("Q_MDP AIHTR", 1), ("clocked bound AIHTR", 1)):
        columns += [Column(f"{label}, {part}", digits) for part in Spread._fields]
    rows = [[*s[:4], *s.accuracy, *s.qmdp, *s.clocked] for s in settings]
    caption = f"Median and range over {len(DRAWS)} draws of the kernel, by setting and pair"
    return Table("sensitivity", caption, columns, rows)


def sensitivity_figures(settings: Sequence[Setting]) -> list[Figure]:
    """Accuracy of Q_MDP, its AIHTR and the clocked bound under each setting, at the lowest price."""
    # At the lowest price all probabilities but 0.15 exceed c/r, and Table II prints one accuracy for three prices.
    mine = [setting for setting in settings if setting.cost == COSTS[0]]
    return [
        _ranges("accuracy", "Accuracy of Q_MDP (%)", mine),
        _ranges("qmdp", "AIHTR of Q_MDP", mine),
        _ranges("clocked", "AIHTR of the clocked bound", mine),
    ]


def _ranges(name: str, label: str, settings: Sequence[Setting]) -> Figure:
    """Medians and ranges of the figure `name` of settings of one price."""
    rows = list(dict.fromkeys((s.border, s.t_max) for s in settings))
    printed = name == "accuracy"

    def paint(figure: Canvas) -> None:
        axes = figure.subplots()
        # The three Z of a setting stand in one row, a little apart.
        for offset, (support_size, look) in zip((-0.24, 0.0, 0.24), COLOURS.items(), strict=True):
            spreads = [getattr(s, name) for s in settings if s.support_size == support_size]
            middle, low, high = np.array(spreads).T
            # Lengths below and above the median. The range, not a confidence interval: how far the draw of the kernel
            # moves a figure.
            axes.errorbar(
                *(middle, np.arange(len(rows)) + offset),
                xerr=np.stack([middle - low, high - middle]),
                label=f"Z = {support_size}",
                fmt=look.marker,
                color=look.color,
                markersize=3.5,
                elinewidth=1.2,
            )
            if printed:
                at = PRINTED_QMDP[support_size, COSTS[0]]
                axes.axvline(at, color=look.color, linewidth=0.8, linestyle=":")
        axes.set_yticks(range(len(rows)), [f"{border}, T_max {t_max}" for border, t_max in rows])
        # The first setting on top, as in the table.
        axes.invert_yaxis()
        axes.set_xlabel(label)
        tidy(axes)
        legend(figure, axes)

    under = f"under the paper's unstated settings, c = {COSTS[0]:g}"
    dotted = "; dotted: the printed values" if printed else ""
    title = f"{label} {under}: median and range, n = {len(DRAWS)} draws{dotted}"
    columns = [*map(Column, ("border", "T_max", "Z"))]
    columns += [Column(part, 2) for part in Spread._fields]
    numbers: Rows = [[*s[:3], *getattr(s, name)] for s in settings]
    table = Table(f"sensitivity-{name}", title, columns, numbers)
    return draw_figure(table, 4.2, paint)


def sections(study: Study, openings: Openings) -> list[Section]:
    """The sections that follow those of any sweep."""
    chosen = pairs(study)
    parts: list[Part] = [f"<p>{_about_accuracy(study, chosen)}</p>", accuracy_table(study, chosen)]
    accuracy = Section("accuracy", "The paper's Table II: accuracy", parts)
    return [*([accuracy] if chosen else []), _worlds(openings), _critique(study, chosen, openings)]


def accuracy_table(study: Study, chosen: Pairs) -> Table:
    """Table II of the paper beside exact accuracies: of Q_MDP, and of each method the mean over seeds."""
    rows: Rows = []
    # The order of Table II: by price, and Z = 5, 4, 3 within one.
    for (support_size, cost), world in sorted(
        chosen.items(), key=lambda item: (item[0][1], -item[0][0])
    ):
        exact = 100 * study.reference(world, "Q_MDP", "accuracy")
        row: list[Cell] = [support_size, cost, PRINTED_QMDP[support_size, cost], exact]
        row.append(PRINTED_TMDP[support_size, cost])
        for method in study.methods:
            values = [100 * run.figure("accuracy") for run in study.of(world, method)]
            row += [float(np.mean(values)) if values else None, len(values)]
        rows.append(row)
    columns = [Column("Z"), Column("c", 2)]
    heads = ("Q_MDP, printed", "Q_MDP, exact", "TMDP, printed")
    columns += [Column(head, 2, "%") for head in heads]
    for method in study.methods:
        columns += [Column(method, 2, "%"), Column(f"n, {method}")]
    return Table(
        "accuracy", "Table II: tracking accuracy, printed and exact; n seeds each", columns, rows
    )


def _about_accuracy(study: Study, chosen: Pairs) -> str:
    """The reference of the printed accuracies, and the learned accuracies that differ from them."""
    words, printed = paragraphs("trackmdp.paper"), PRINTED_TMDP.values()
    a2c = [
        100 * run.figure("accuracy") for world in chosen.values() for run in study.of(world, "a2c")
    ]
    # Only where the two ranges are apart; where they overlap nothing is claimed.
    if not a2c or min(a2c) <= max(printed):
        return words["accuracy"]
    theirs, ours = (f"{min(each):.1f} to {max(each):.1f} %" for each in (printed, a2c))
    return f"{words['accuracy']} {words['not reproduced'].format(theirs=theirs, ours=ours)}"


def _worlds(openings: Openings) -> Section:
    best = fit_table(openings.settings)
    # `fit_table` puts the best setting first.
    border, t_max, *_, worst = best.rows[0]
    words = paragraphs("trackmdp.paper")
    fit = words["fit"].format(border=border, t_max=t_max, worst=worst, draws=len(DRAWS))
    first, *_, last = calibration.SEEDS
    rule = words["rule"].format(
        first=first, last=last, t_max=calibration.T_MAX, border=calibration.BORDER
    )
    figure, drawn = calibration_figure(openings.candidates), sensitivity_figures(openings.settings)
    parts: list[Part] = [f"<p>{rule}</p>", [figure], f"<p>{fit}</p>", best, drawn]
    tables = [candidates_table(openings.candidates), sensitivity_table(openings.settings)]
    return Section("worlds", "The paper's worlds, calibrated", parts, tables)


def _critique(study: Study, chosen: Pairs, openings: Openings) -> Section:
    bounds = bounds_table(study, chosen)
    parts: list[Part] = [
        _points(bounds.rows, openings.checks),
        bounds,
        checks_table(openings.checks),
    ]
    return Section("critique", "Where the paper is silent or wrong", parts)


def checks_table(found: Iterable[Check]) -> Table:
    """Every statement checked, with its largest deviation; -inf where there was no case to check."""
    rows: Rows = [
        [
            c.name,
            c.statement,
            None if c.deviation == NO_CASE else f"{c.deviation:.1e}",
            c.verdict,
            c.note,
        ]
        for c in found
    ]
    columns = [*map(Column, ("theorem", "statement", "largest deviation", "verdict", "note"))]
    caption = f"The paper's statements on the world with Z = {calibration.HARDEST}, c = {COSTS[0]}"
    return Table("theorems", caption, columns, rows)


def bounds_table(study: Study, pairs: Pairs) -> Table:
    """The bounds of each pair beside the best policy known: marked where the printed one is below its value."""
    rows: Rows = []
    for (support_size, cost), world in pairs.items():
        # Bounds are the world's, so that any run has them; the bracket of the optimum is the best that some run found.
        best, upper = study.best(world), study.upper(world)
        printed, valid, clocked = (
            study.reference(world, f"{name} bound", "aihtr")
            for name in ("printed", "valid", "clocked")
        )
        # Relative: the solver's bracket is closed to rounding of values that grow with the episode's length.
        proved = upper - best <= 1e-6 * max(1.0, abs(best))
        # eq. upper_bound_v charges sensors on the exit step, the reward (eq. reward_func) does not: a policy may earn
        # more.
        below = best > printed + 1e-9
        simple = study.reference(world, "Q_MDP", "aihtr")
        row: list[Cell] = [support_size, cost, simple, best, upper, proved]
        rows.append([*row, clocked, valid, printed, below])
    columns = [Column("Z"), Column("c", 2), Column("Q_MDP", 3)]
    columns += [Column("optimum, attained", 4), Column("optimum, at most", 4), Column("proved")]
    columns += [Column(f"{kind} bound", 3) for kind in ("clocked", "valid", "printed")]
    columns.append(Column("printed bound is exceeded"))
    caption = "AIHTR: Q_MDP, the proved bracket of the optimum, and the bounds, exactly"
    return Table("bounds", caption, columns, rows)


def _points(bounds: Sequence[Sequence[Any]], found: Iterable[Check]) -> str:
    """The headings and paragraphs of `critique.txt`, in the order of the paper, with the figures of this sweep.

    Args:
        bounds: rows of `bounds_table`.
        found: the statements checked.
    """
    exceeded, short = [], []
    for z, cost, _, best, _, _, clocked, *_, below in bounds:
        if below:
            exceeded.append(f"(Z = {z}, c = {cost:g})")
        # U is the optimum where its policy leaves at most one cell of positive probability unsensed; elsewhere the
        # optimum takes a search, and may lie below.
        if clocked - best > 1e-6 * max(1.0, abs(clocked)):
            short.append(f"Z = {z}, c = {cost:g} ({clocked - best:.3f} missing)")
    named = {check.name: check for check in found}
    facts = {
        "exceeded": len(exceeded),
        "pairs": len(bounds),
        "where": ", ".join(exceeded) or "none",
        "remark": named["the printed bound"].note,
        "printed": named["Theorem 3, as printed"],
        "exact": named["Theorem 3, exact form"],
        "attained": len(bounds) - len(short),
        "rest": f", by none that is known in {'; '.join(short)}" if short else "",
    }
    points = paragraphs("trackmdp.paper", "critique.txt").items()
    return "".join(
        f"<h3>{html.escape(head)}</h3><p>{html.escape(text.format(**facts))}</p>"
        for head, text in points
    )
