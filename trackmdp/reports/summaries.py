"""Tables of results: by method, by world and method, by run, and of missing runs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from trackmdp.config.compose import compose
from trackmdp.errors import UserError
from trackmdp.reports.grouping import Study
from trackmdp.reports.results import Anomaly
from trackmdp.reports.tables import Cell, Column, Table
from trackmdp.statistics import MeanInterval, iqm, mean_over_groups

OPEN = 5e-5
"""Bracket per step from which a regret is shown as a range."""
TIMES = [Column("wall", 1, "s"), Column("CPU", 1, "s")]


def estimate_columns(label: str, digits: int) -> list[Column]:
    """Columns for what `estimate_cells` gives."""
    return [Column(label, digits), Column("95 % from", digits), Column("to", digits)]


def estimate_cells(found: MeanInterval) -> list[Cell]:
    """Mean and interval as cells."""
    return [found.mean, found.low, found.high]


def methods_table(study: Study, threshold: float | None) -> Table:
    """Each method over all its worlds; with a `threshold`, how many runs end at most that far from the bound."""
    rows: list[list[Cell]] = []
    for method in study.methods:
        # Worlds stay apart until they are averaged: seeds of different worlds are no sample of one distribution.
        groups = [group for world in study.worlds if (group := study.regrets(world, method))]
        regrets = [regret for group in groups for regret in group]
        runs = [run for world in study.worlds for run in study.of(world, method)]
        spread: list[Cell] = [float(np.median(regrets)), max(regrets)] if regrets else [None, None]
        means = [float(np.mean([run.figure(key) for run in runs])) for key in ("frames", "wall_seconds", "cpu_seconds")]
        regret = [*estimate_cells(mean_over_groups(groups)), iqm(groups), *spread]
        rows.append([method, len(groups), len(regrets), *regret, *_within(regrets, threshold), *means])
    columns = [Column("method"), Column("worlds"), Column("n"), *estimate_columns("regret per step, mean", 4)]
    columns += [Column("interquartile mean", 4), Column("median", 4), Column("worst", 4), *_within_column(threshold)]
    columns += [Column("env steps", 0), *TIMES]
    caption = "All methods: regret per step, n runs, every world with the same weight; what a run takes on average"
    return Table("methods", caption + _open(study), columns, rows)


def _open(study: Study) -> str:
    """The worlds whose optimum is not certified to four digits of the regret, and by how much."""
    wide = {world: width for world in study.worlds if (width := study.bracket(world)) >= OPEN}
    if not wide:
        return ""
    listed = ", ".join(f"{world} by {width:.4f}" for world, width in wide.items())
    return f"; regrets are to the proved bound, which may be too high where the optimum is not certified: {listed}"


def shortened(study: Study) -> list[str]:
    """Methods whose runs have fewer env steps than their shipped options give: ``ppo: 1,024,000 of 2,048,000``."""
    found = []
    for method in study.methods:
        run = next(run for world in study.worlds for run in study.of(world, method))
        try:
            shipped = compose("train", {"algo": run.algo, "grid.size": run.settings["grid.size"]})
        except UserError:  # an algorithm that is not installed here, or one that another word chooses
            continue
        # As the options of today's `conf/` are; grids of another size have other budgets.
        taken, full = run.figure("frames"), shipped.algo.total_frames
        found += [f"{method}: {taken:,.0f} of {full:,}"] if taken < full else []
    return found


def groups_table(study: Study, threshold: float | None) -> Table:
    """Each method in each world, its seeds together."""
    rows: list[list[Cell]] = []
    for (world, method), runs in study.groups.items():
        regrets = study.regrets(world, method)
        earned = mean_over_groups([[run.figure("aihtr") for run in runs]])
        rest = [float(np.mean([run.figure(key) for run in runs])) for key in ("accuracy", "sensors_per_step")]
        means = [*estimate_cells(earned), *estimate_cells(mean_over_groups([regrets])), *_within(regrets, threshold)]
        rows.append([world, method, len(runs), *means, 100 * rest[0], rest[1]])
    columns = [Column("world"), Column("method"), Column("n"), *estimate_columns("AIHTR, mean", 3)]
    columns += [*estimate_columns("regret per step, mean", 4), *_within_column(threshold)]
    columns += [Column("accuracy", 2, "%"), Column("sensors per step", 3)]
    return Table("groups", "Every world and method: means over n seeds", columns, rows)


def runs_table(study: Study) -> Table:
    """Every finished run."""
    rows: list[list[Cell]] = []
    for (world, method), runs in study.groups.items():
        for run in runs:
            aihtr, accuracy, sensors = (run.figure(key) for key in ("aihtr", "accuracy", "sensors_per_step"))
            times = [run.figure(key) for key in ("wall_seconds", "cpu_seconds")]
            regret = study.regret(run, world)
            row: list[Cell] = [world, method, run.seed, int(run.figure("frames")), aihtr]
            rows.append([*row, regret - study.bracket(world), regret, 100 * accuracy, sensors, *times, run.name])
    columns = [Column("world"), Column("method"), Column("seed"), Column("env steps"), Column("AIHTR", 3)]
    columns += [Column("regret per step to the best known", 5), Column("to the bound", 5)]
    columns += [Column("accuracy", 2, "%"), Column("sensors per step", 3), *TIMES]
    return Table("runs", f"All {len(rows)} finished runs", [*columns, Column("folder")], rows)


def missing_table(anomalies: Sequence[Anomaly]) -> Table:
    """What is missing, mixed or damaged."""
    rows = [[anomaly.run, anomaly.text] for anomaly in anomalies]
    return Table("missing", "What is missing or not like the rest", [Column("run"), Column("what")], rows)


def _within_column(threshold: float | None) -> list[Column]:
    return [] if threshold is None else [Column(f"runs ≤ {threshold:g}")]


def _within(regrets: Sequence[float], threshold: float | None) -> list[Cell]:
    return [] if threshold is None else [sum(regret <= threshold for regret in regrets)]
