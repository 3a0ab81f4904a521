"""The paper's part of a report: Table II beside exact accuracies, open settings, and where it is silent or wrong."""

from __future__ import annotations

import html
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from trackmdp.paper import settings
from trackmdp.paper.calibration import BORDER, DRAWS, SEEDS, T_MAX
from trackmdp.paper.openings import HARDEST, Openings
from trackmdp.paper.theorems import Check
from trackmdp.paper.worlds import COSTS, PRINTED_QMDP, PRINTED_TMDP, pairs
from trackmdp.reports.grouping import Study
from trackmdp.reports.page import Part, Section
from trackmdp.reports.prose import paragraphs
from trackmdp.reports.tables import Cell, Column, Table


def sections(study: Study, openings: Openings) -> list[Section]:
    """The sections that follow those of any sweep."""
    chosen = pairs(study)
    said: list[Part] = [f"<p>{_about_accuracy(study, chosen)}</p>", accuracy_table(study, chosen)]
    accuracy = Section("accuracy", "The paper's Table II: accuracy", said)
    return [*([accuracy] if chosen else []), _worlds(openings), _critique(study, chosen, openings)]


def accuracy_table(study: Study, chosen: Mapping[tuple[int, float], str]) -> Table:
    """Table II of the paper beside exact accuracies: of Q_MDP, and of each method the mean over seeds."""
    rows: list[list[Cell]] = []
    # The order of Table II: by price, and Z = 5, 4, 3 within one.
    for (support_size, cost), world in sorted(chosen.items(), key=lambda item: (item[0][1], -item[0][0])):
        first = study.in_world(world)[0]
        row: list[Cell] = [support_size, cost, PRINTED_QMDP[support_size, cost], 100 * first.figure("qmdp_accuracy")]
        row.append(PRINTED_TMDP[support_size, cost])
        for method in study.methods:
            values = [100 * run.figure("accuracy") for run in study.of(world, method)]
            row += [float(np.mean(values)) if values else None, len(values)]
        rows.append(row)
    columns = [Column("Z"), Column("c", 2), Column("Q_MDP, printed", 2, "%"), Column("Q_MDP, exact", 2, "%")]
    columns.append(Column("TMDP, printed", 2, "%"))
    for method in study.methods:
        columns += [Column(method, 2, "%"), Column("n")]
    return Table("accuracy", "Table II: tracking accuracy, printed and exact; n seeds each", columns, rows)


def _about_accuracy(study: Study, chosen: Mapping[tuple[int, float], str]) -> str:
    """What the printed accuracies can be held against, and that the learned ones are not reproduced."""
    told, printed = paragraphs("trackmdp.paper"), PRINTED_TMDP.values()
    a2c = [100 * run.figure("accuracy") for world in chosen.values() for run in study.of(world, "a2c")]
    # Said only where the two ranges are apart; where they overlap nothing is claimed.
    if not a2c or min(a2c) <= max(printed):
        return told["accuracy"]
    theirs, ours = (f"{min(each):.1f} to {max(each):.1f} %" for each in (printed, a2c))
    return f"{told['accuracy']} {told['not reproduced'].format(theirs=theirs, ours=ours)}"


def _worlds(openings: Openings) -> Section:
    best = settings.fit_table(openings.settings)
    # `fit_table` puts the best setting first.
    border, t_max, *_, worst = best.rows[0]
    told = paragraphs("trackmdp.paper")
    fit = told["fit"].format(border=border, t_max=t_max, worst=worst, draws=len(DRAWS))
    rule = told["rule"].format(first=SEEDS[0], last=SEEDS[-1], t_max=T_MAX, border=BORDER)
    drawn = settings.sensitivity_figures(openings.settings)
    figure = settings.calibration_figure(openings.candidates)
    parts: list[Part] = [f"<p>{rule}</p>", [figure], f"<p>{fit}</p>", best, drawn]
    tables = [settings.candidates_table(openings.candidates), settings.sensitivity_table(openings.settings)]
    return Section("worlds", "The paper's worlds, calibrated", parts, tables)


def _critique(study: Study, chosen: Mapping[tuple[int, float], str], openings: Openings) -> Section:
    bounds = bounds_table(study, chosen)
    text = _points(study, bounds, chosen, openings.checks)
    return Section("critique", "Where the paper is silent or wrong", [text, bounds, checks_table(openings.checks)])


def checks_table(found: Iterable[Check]) -> Table:
    """Every statement checked, with its largest deviation; -inf where there was no case to check."""
    rows: list[list[Cell]] = [
        [c.name, c.statement, None if c.deviation == float("-inf") else f"{c.deviation:.1e}", c.verdict, c.note]
        for c in found
    ]
    columns = [Column("theorem"), Column("statement"), Column("largest deviation"), Column("verdict"), Column("note")]
    return Table("theorems", f"The paper's statements on the world with Z = {HARDEST}, c = {COSTS[0]}", columns, rows)


def bounds_table(study: Study, pairs: Mapping[tuple[int, float], str]) -> Table:
    """The bounds of each pair beside the optimum: where the printed one is below what a policy earns."""
    rows: list[list[Cell]] = []
    for (support_size, cost), world in pairs.items():
        # Bounds are the world's, so that any run has them; the bracket of the optimum is the best that some run found.
        run, best, upper = study.in_world(world)[0], study.lower(world), study.upper(world)
        printed = run.figure("bound_paper")
        # Relative: the solver's bracket is closed to rounding of values that grow with the episode's length.
        proved = None if best is None else upper - best <= 1e-6 * max(1.0, abs(best))
        # eq. upper_bound_v charges sensors on the exit step, the reward (eq. reward_func) does not: a policy may earn
        # more.
        below = None if best is None else best > printed + 1e-9
        row: list[Cell] = [support_size, cost, run.figure("qmdp_aihtr"), best, upper, proved]
        rows.append([*row, run.figure("bound_clocked"), run.figure("bound_valid"), printed, below])
    columns = [Column("Z"), Column("c", 2), Column("Q_MDP", 3), Column("optimum, attained", 4)]
    columns += [Column("optimum, at most", 4), Column("proved"), Column("clocked bound", 3), Column("valid bound", 3)]
    columns += [Column("printed bound", 3), Column("printed bound is exceeded")]
    return Table("bounds", "AIHTR: Q_MDP, the proved bracket of the optimum, and the bounds, exactly", columns, rows)


def _points(study: Study, table: Table, pairs: Mapping[tuple[int, float], str], found: Sequence[Check]) -> str:
    """The headings and paragraphs of `critique.txt`, in the order of the paper, with the figures of this sweep."""
    facts = _exit_price(table, found) | _theorem_three(found) | _hardest(study, pairs)
    points = ((head, text.format(**facts)) for head, text in paragraphs("trackmdp.paper", "critique.txt").items())
    return "".join(f"<h3>{html.escape(head)}</h3><p>{html.escape(body)}</p>" for head, body in points)


def _exit_price(table: Table, found: Sequence[Check]) -> dict[str, Any]:
    # `is True`: the last column is None where no optimum is known.
    exceeded = [f"(Z = {row[0]}, c = {row[1]:g})" for row in table.rows if row[-1] is True]
    remark = next((check.note for check in found if check.name == "the printed bound"), "")
    return {
        "exceeded": len(exceeded),
        "pairs": len(table.rows),
        "where": ", ".join(exceeded) or "none",
        "remark": remark,
    }


def _theorem_three(found: Sequence[Check]) -> dict[str, Any]:
    forms = ("as printed", "exact form")
    printed, exact = (next(each for each in found if each.name == f"Theorem 3, {form}") for form in forms)
    return {"printed": printed, "exact": exact}


def _hardest(study: Study, pairs: Mapping[tuple[int, float], str]) -> dict[str, Any]:
    """How tight the clocked bound is, and where it is not attained."""
    short = {}
    for (support_size, cost), world in pairs.items():
        bound, best = study.in_world(world)[0].figure("bound_clocked"), study.lower(world)
        # U is the optimum where its policy leaves at most one cell of positive probability unsensed; elsewhere the
        # optimum takes a search, and may lie below.
        if best is not None and bound - best > 1e-6 * max(1.0, abs(bound)):
            short[f"Z = {support_size}, c = {cost:g}"] = bound - best
    missed = "; ".join(f"{pair} (by {gap:.3f})" for pair, gap in short.items())
    rest = f"; not in {missed}, where the optimum takes a search" if missed else ""
    return {"attained": len(pairs) - len(short), "rest": rest}
