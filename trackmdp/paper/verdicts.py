"""Tables of what came out: accuracy beside the printed numbers, what was asked for and what was reached, every run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from trackmdp.paper.printed import PRINTED_QMDP, PRINTED_TMDP
from trackmdp.reports.grouping import Study
from trackmdp.reports.results import Problem
from trackmdp.reports.statistics import estimate
from trackmdp.reports.tables import Cell, Column, Table

__all__ = [
    "Goal",
    "acceptance_table",
    "accuracy_table",
    "goals",
    "groups_table",
    "methods_table",
    "missing_table",
    "runs_table",
]

PAPERS, DEFAULT = "a2c", "hindsight"
PAPERS_LIMIT, DEFAULT_LIMIT = 0.02, 0.01


@dataclass(frozen=True)
class Goal:
    """What was asked for in every pair, and in how many it was reached.

    Attributes:
        text: the goal.
        pairs: pairs in which there are runs to judge by.
        met: of them, those where the interquartile mean over seeds meets it.
        by_all: of them, those where every seed does.
        missed: the pairs where the interquartile mean does not.
    """

    text: str
    pairs: int
    met: int
    by_all: int
    missed: Sequence[str]


def goals(study: Study, pairs: Mapping[tuple[int, float], str], resamples: int) -> list[Goal]:
    """A2C above Q_MDP; A2C and the default within their distances to the proved upper bound."""
    return [
        _goal("A2C earns more than Q_MDP", study, pairs, PAPERS, None, resamples),
        _goal(f"A2C within {PAPERS_LIMIT} per step of the optimum", study, pairs, PAPERS, PAPERS_LIMIT, resamples),
        _goal(f"the default within {DEFAULT_LIMIT} per step", study, pairs, DEFAULT, DEFAULT_LIMIT, resamples),
    ]


def acceptance_table(study: Study, pairs: Mapping[tuple[int, float], str], resamples: int) -> Table:
    """Each pair with what was asked for."""
    rows: list[list[Cell]] = []
    for (support_size, cost), world in pairs.items():
        first = study.in_world(world)[0]
        theirs = _aihtr(study, world, PAPERS, resamples)
        simple = first.figure("qmdp_aihtr")
        row: list[Cell] = [support_size, cost, simple, theirs, None if theirs is None else theirs > simple]
        for method, limit in ((PAPERS, PAPERS_LIMIT), (DEFAULT, DEFAULT_LIMIT)):
            regrets = study.regrets(world, method)
            mean = estimate([regrets], "regret", method, world, resamples=resamples).mean if regrets else None
            row += [mean, max(regrets, default=None), None if mean is None else mean <= limit, len(regrets)]
        rows.append(row)
    columns = [
        Column("Z"),
        Column("c", 2),
        Column("Q_MDP AIHTR", 3),
        Column("A2C AIHTR", 3),
        Column("A2C above", judged=True),
    ]
    for label, limit in (("A2C", PAPERS_LIMIT), ("default", DEFAULT_LIMIT)):
        columns += [
            Column(f"{label} regret per step", 4),
            Column("worst seed", 4),
            Column(f"≤ {limit:g}", judged=True),
            Column("n"),
        ]
    caption = "What was asked for, pair by pair: interquartile means over n seeds"
    return Table("acceptance", caption, columns, rows)


def accuracy_table(study: Study, pairs: Mapping[tuple[int, float], str], resamples: int) -> Table:
    """Table II of the paper beside exact accuracies: of Q_MDP, and of each method the interquartile mean."""
    rows: list[list[Cell]] = []
    for (support_size, cost), world in sorted(pairs.items(), key=lambda item: (item[0][1], -item[0][0])):
        first = study.in_world(world)[0]
        row: list[Cell] = [support_size, cost, PRINTED_QMDP[support_size, cost], 100 * first.figure("qmdp_accuracy")]
        row.append(PRINTED_TMDP[support_size, cost])
        for method in study.methods:
            values = [100 * run.figure("accuracy") for run in study.of(world, method)]
            found = estimate([values], "accuracy", method, world, resamples=resamples)
            row += [found.mean if found.n else None, found.n]
        rows.append(row)
    columns = [Column("Z"), Column("c", 2), Column("Q_MDP, printed", 2, "%"), Column("Q_MDP, exact", 2, "%")]
    columns.append(Column("TMDP, printed", 2, "%"))
    for method in study.methods:
        columns += [Column(method, 2, "%"), Column("n")]
    return Table("accuracy", "Table II: tracking accuracy, printed and exact; n seeds each", columns, rows)


def methods_table(study: Study, resamples: int) -> Table:
    """Each method over all its worlds."""
    rows: list[list[Cell]] = []
    for method in study.methods:
        groups = [study.regrets(world, method) for world in study.worlds]
        everything = np.array([regret for group in groups for regret in group] or [np.nan])
        found = estimate(groups, "regret", method, resamples=resamples)
        runs = [run for world in study.worlds for run in study.of(world, method)]
        row: list[Cell] = [
            method,
            len([group for group in groups if group]),
            found.n,
            found.mean,
            found.low,
            found.high,
        ]
        row += [float(np.median(everything)), float(everything.max())]
        row += [float((everything <= level).mean()) for level in (DEFAULT_LIMIT, PAPERS_LIMIT)]
        row += [float(np.mean([run.figure(key) for run in runs])) for key in ("frames", "wall_seconds", "cpu_seconds")]
        rows.append(row)
    columns = [Column("method"), Column("worlds"), Column("n"), Column("regret per step, IQM", 4)]
    columns += [Column("95 % from", 4), Column("to", 4), Column("median", 4), Column("worst", 4)]
    columns += [Column("share ≤ 0.01", 2), Column("share ≤ 0.02", 2), Column("env steps", 0)]
    columns += [Column("wall", 1, "s"), Column("CPU", 1, "s")]
    caption = "All methods: regret per step over worlds and seeds (n runs), and what a run takes on average"
    return Table("methods", caption, columns, rows)


def groups_table(study: Study, resamples: int) -> Table:
    """Each method in each world, its seeds together."""
    rows: list[list[Cell]] = []
    for world in study.worlds:
        for method in study.methods:
            runs = study.of(world, method)
            if not runs:
                continue
            earned = estimate([[r.figure("aihtr") for r in runs]], "aihtr", method, world, resamples=resamples)
            regret = estimate([study.regrets(world, method)], "regret", method, world, resamples=resamples)
            rest = [float(np.mean([r.figure(key) for r in runs])) for key in ("accuracy", "sensors_per_step")]
            row: list[Cell] = [world, method, len(runs), earned.mean, earned.low, earned.high]
            rows.append([*row, regret.mean, regret.low, regret.high, 100 * rest[0], rest[1]])
    columns = [Column("world"), Column("method"), Column("n"), Column("AIHTR, IQM", 3), Column("95 % from", 3)]
    columns += [Column("to", 3), Column("regret per step, IQM", 4), Column("95 % from", 4), Column("to", 4)]
    columns += [Column("accuracy", 2, "%"), Column("sensors per step", 3)]
    return Table("groups", "Every world and method: interquartile means over n seeds", columns, rows)


def runs_table(study: Study) -> Table:
    """Every finished run."""
    rows: list[list[Cell]] = []
    for world in study.worlds:
        for method in study.methods:
            for run in study.of(world, method):
                figures = [run.figure(key) for key in ("aihtr", "accuracy", "sensors_per_step")]
                times = [run.figure(key) for key in ("wall_seconds", "cpu_seconds")]
                row: list[Cell] = [world, method, run.seed, int(run.figure("frames")), figures[0]]
                rows.append([*row, study.regret(run, world), 100 * figures[1], figures[2], *times, run.name])
    columns = [Column("world"), Column("method"), Column("seed"), Column("env steps"), Column("AIHTR", 3)]
    columns += [Column("regret per step", 5), Column("accuracy", 2, "%"), Column("sensors per step", 3)]
    columns += [Column("wall", 1, "s"), Column("CPU", 1, "s"), Column("folder")]
    return Table("runs", f"All {len(rows)} finished runs", columns, rows)


def missing_table(problems: Sequence[Problem]) -> Table:
    """What is missing, mixed or damaged."""
    rows = [[problem.run, problem.text] for problem in problems]
    return Table("missing", "What is missing or not like the rest", [Column("run"), Column("what")], rows)


def _aihtr(study: Study, world: str, method: str, resamples: int) -> float | None:
    values = [run.figure("aihtr") for run in study.of(world, method)]
    return estimate([values], "aihtr", method, world, resamples=resamples).mean if values else None


def _goal(
    text: str,
    study: Study,
    pairs: Mapping[tuple[int, float], str],
    method: str,
    limit: float | None,
    resamples: int,
) -> Goal:
    judged, missed, by_all = 0, [], 0
    for (support_size, cost), world in pairs.items():
        runs = study.of(world, method)
        if not runs:
            continue
        judged += 1
        if limit is None:
            simple = runs[0].figure("qmdp_aihtr")
            excess = [simple - run.figure("aihtr") for run in runs]
            mean, each = estimate([excess], "excess", world, resamples=resamples).mean < 0, [e < 0 for e in excess]
        else:
            regrets = study.regrets(world, method)
            mean = estimate([regrets], "regret", method, world, resamples=resamples).mean <= limit
            each = [regret <= limit for regret in regrets]
        by_all += all(each)
        if not mean:
            missed.append(f"Z = {support_size}, c = {cost:g}")
    return Goal(text, judged, judged - len(missed), by_all, missed)
