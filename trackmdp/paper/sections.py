"""The paper's part of a report: Table II beside exact accuracies, open settings, and where it is silent or wrong."""

from __future__ import annotations

import html
from collections.abc import Mapping

import numpy as np

from trackmdp.paper import critique, settings
from trackmdp.paper.calibration import DRAWS
from trackmdp.paper.openings import Openings
from trackmdp.paper.printed import PRINTED_QMDP, PRINTED_TMDP, pairs
from trackmdp.reports.grouping import Study
from trackmdp.reports.page import Part, Section
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
    printed = PRINTED_TMDP.values()
    text = "Of the paper's results this table alone is set beside printed numbers; its Figures 3 to 5 print no values. "
    a2c = [100 * run.figure("accuracy") for world in chosen.values() for run in study.of(world, "a2c")]
    # Said only where the two ranges are apart; where they overlap nothing is claimed.
    if not a2c or min(a2c) <= max(printed):
        return text
    return text + (
        f"The paper's learned policies detect the target in {min(printed):.1f} to {max(printed):.1f} % of the steps, "
        f"A2C here in {min(a2c):.1f} to {max(a2c):.1f} %: that column is not reproduced. The most likely reasons are "
        "what the paper leaves open (T_max, the kernels, the border, the network, the length of training), and a "
        "learner that stopped before every cell that is worth its price was sensed."
    )


def _worlds(openings: Openings) -> Section:
    best = settings.fit_table(openings.settings)
    # `fit_table` puts the best setting first.
    border, t_max, *_, worst = best.rows[0]
    note = (
        f"<p>Nothing in the paper tells the settings apart but the printed accuracy of Q_MDP. Of those tried, border "
        f"{border} with T_max = {t_max} fits it best (within {worst:.2f} points for every Z, with {len(DRAWS)} draws "
        "only); the kernels above are for T_max = 1 and renormalize, this project's defaults.</p>"
    )
    rule = f"<p>{html.escape(settings.RULE)}</p>"
    drawn = settings.sensitivity_figures(openings.settings)
    parts: list[Part] = [rule, [settings.calibration_figure(openings.candidates)], note, best, drawn]
    tables = [settings.candidates_table(openings.candidates), settings.sensitivity_table(openings.settings)]
    return Section("worlds", "The paper's worlds, calibrated", parts, tables)


def _critique(study: Study, chosen: Mapping[tuple[int, float], str], openings: Openings) -> Section:
    said = critique.points(study, chosen, openings.checks)
    text = "".join(f"<h3>{html.escape(head)}</h3><p>{html.escape(body)}</p>" for head, body in said)
    tables = [critique.bounds_table(study, chosen), critique.checks_table(openings.checks)]
    return Section("critique", "Where the paper is silent or wrong", [text, *tables])
