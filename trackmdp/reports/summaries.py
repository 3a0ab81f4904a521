"""Tables of results: by policy, by world and method, by run, and of missing runs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from statistics import fmean

from trackmdp.config.compose import compose
from trackmdp.errors import UserError
from trackmdp.reports.grouping import OPEN, Study
from trackmdp.reports.tables import Cell, Column, Rows, Table, interval_columns
from trackmdp.statistics import iqm, mean_over_groups

FIGURES = {
    "aihtr": Column("AIHTR", 3),
    "accuracy": Column("accuracy", 2, "%"),
    "sensors_per_step": Column("sensors per step", 3),
    "held_out_aihtr": Column("held-out AIHTR", 3),
    "held_out_accuracy": Column("held-out accuracy", 2, "%"),
    "held_out_sensors_per_step": Column("held-out sensors per step", 3),
    "frames": Column("env steps", 0),
    "wall_seconds": Column("wall", 1, "s"),
    "cpu_seconds": Column("CPU", 1, "s"),
    "regret": Column("regret per step", 5),
}
"""Columns of every table of results."""


def figure_cells(values: Mapping[str, float]) -> list[Cell]:
    """Cells of the columns `FIGURES`, from their values with accuracies as shares."""
    return [(100 if each.unit == "%" else 1) * values[key] for key, each in FIGURES.items()]


OPEN_ENDS = [Column("best AIHTR known", 3), Column("upper bound", 3)]
"""Of worlds whose optimum is not certified, as those of several targets."""


def outcome_table(study: Study, threshold: float | None) -> Table:
    """Each method and each policy it is compared with, over all worlds, every world with the same weight.

    With a `threshold`, also the number of runs with a regret of at most that.
    """
    spread = [*interval_columns(5), Column("interquartile mean", 5), Column("worst", 5)]
    spread += [*_within_column(threshold), Column("n")]
    rows: Rows = []
    for method in study.methods:
        groups = {key: [study.values(w, method, key) for w in study.worlds] for key in FIGURES}
        means = {key: mean_over_groups(each) for key, each in groups.items()}
        regrets = [regret for group in groups["regret"] for regret in group]
        cells = figure_cells({key: each.mean for key, each in means.items()})
        rest = [iqm(groups["regret"]), max(regrets, default=None), *_within(regrets, threshold)]
        count = len(study.of(method=method))
        rows.append([method, *cells, means["regret"].low, means["regret"].high, *rest, count])
    for name in study.references():
        if not name.endswith("bound"):  # a bound has neither accuracy nor sensors
            cells = figure_cells(
                {key: fmean(study.reference(w, name, key) for w in study.worlds) for key in FIGURES}
            )
            rows.append([study.title(name), *cells, *[None] * len(spread)])
    columns = [Column("policy"), *FIGURES.values(), *spread]
    caption = "Means over worlds, every world with the same weight, and over n runs"
    return Table("outcome", caption + _note(study), columns, rows)


def _note(study: Study) -> str:
    """Methods without runs in some worlds, worlds whose optimum is not certified to four digits, and tracks."""
    wide = {world: width for world in study.worlds if (width := study.bracket(world)) >= OPEN}
    listed = ", ".join(f"{world} by {width:.4f}" for world, width in wide.items())
    ran, count = Counter(method for _, method in study.groups), len(study.worlds)
    fewer = ", ".join(
        f"{each} {ran[each]} of {count}" for each in study.methods if ran[each] < count
    )
    note = f"; not in all worlds: {fewer}" if fewer else ""
    note += (
        f"; regrets may be too large where the optimum is not certified: {listed}" if wide else ""
    )
    if any(run.settings.get("targets.count", 1) != 1 for run in study.of()):
        note += "; several targets: of all together, the best known being single optima merged"
    tracks = any("held_out_aihtr" in run.figures for run in study.of())
    return note + ("; on recordings, AIHTR of the validation tracks" if tracks else "")


def shortened(study: Study) -> list[str]:
    """Methods with fewer env steps than the options of the algorithm give them: ``ppo: 1,024,000 of 1,536,000``."""
    found = []
    for method in study.methods:
        run = study.of(method=method)[0]
        try:
            shipped = compose("train", {"algo": run.algo, "grid.size": run.settings["grid.size"]})
        except UserError:  # an algorithm that is not installed here, or an older name
            continue
        taken, full = run.figure("frames"), shipped.algo.total_frames
        found += [f"{method}: {taken:,.0f} of {full:,}"] if taken < full else []
    return found


def groups_table(study: Study, threshold: float | None) -> Table:
    """Each method in each world, its seeds together."""
    rows: Rows = []
    for (world, method), runs in study.groups.items():
        known = {key: mean_over_groups([study.values(world, method, key)]) for key in FIGURES}
        cells = figure_cells({key: each.mean for key, each in known.items()})
        ends = [each for key in ("aihtr", "regret") for each in (known[key].low, known[key].high)]
        within = _within(study.values(world, method, "regret"), threshold)
        rows.append([world, method, *cells, *study.ends(world), *ends, *within, len(runs)])
    columns = [Column("world"), Column("method"), *FIGURES.values(), *OPEN_ENDS]
    columns += [*interval_columns(3, "AIHTR: "), *interval_columns(5, "regret: ")]
    caption = (
        "Every world and method: means over n seeds, with intervals of the AIHTR and of the regret"
    )
    columns += [*_within_column(threshold), Column("n")]
    return Table("groups", caption, columns, rows, folded="By world and method")


def runs_table(study: Study) -> Table:
    """Every finished run."""
    rows: Rows = []
    for (world, method), runs in study.groups.items():
        for run in runs:
            cells = figure_cells({key: study.value(world, run, key) for key in FIGURES})
            best = study.regret(run, world) - study.bracket(world)
            rows.append([world, method, run.seed, *cells, *study.ends(world), best, run.name])
    columns = [Column("world"), Column("method"), Column("seed"), *FIGURES.values(), *OPEN_ENDS]
    columns += [Column("regret per step to the best known", 5), Column("folder")]
    caption = f"All {len(rows)} finished runs"
    return Table("runs", caption, columns, rows, folded="Every run")


def _within_column(threshold: float | None) -> list[Column]:
    return [] if threshold is None else [Column(f"runs ≤ {threshold:g}")]


def _within(regrets: Sequence[float], threshold: float | None) -> list[Cell]:
    return [] if threshold is None else [sum(regret <= threshold for regret in regrets)]
