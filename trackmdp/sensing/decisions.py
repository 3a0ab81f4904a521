"""The decisions of a step: the only place that asks for the kind of sensors a task has."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np

from trackmdp.arrays.entries import among, per_row, row_index
from trackmdp.arrays.types import Array, IndexArray
from trackmdp.sensing.choose import Own
from trackmdp.sensing.cover import Shared
from trackmdp.sensing.task import Task

Decisions: TypeAlias = Own | Shared
"""Decisions of one step."""


def sensing(
    task: Task,
    rows: IndexArray,
    cells: IndexArray,
    count: int,
    located: IndexArray | None = None,
    *,
    distinct: bool = False,
) -> Decisions:
    """The decisions about entries of plans `rows` `[E]` with the target in `cells` `[E]`.

    Args:
        task: its sensors.
        rows: plan of each entry.
        cells: cell of each entry.
        count: K, plans.
        located: `[K]`, located cell of each plan, where the window of the task limits its sets; None: it does not.
        distinct: whether entries are known to be in order of (row, cell), no two of them alike.
    """
    if task.coverage is None:
        return Own.of(task, rows, cells, count, located, distinct=distinct)
    return Shared.of(task, rows, cells, count, located)


def report_chance(task: Task, on: IndexArray, rows: IndexArray, cells: IndexArray) -> Array:
    """`[E]`, probability that some sensor that is on reports a target in `cells` `[E]`.

    Args:
        task: its sensors.
        on: sorted numbers row · S + s of the sensors s that are on in a row.
        rows: `[E]`, row of each entry.
        cells: cell of each entry.
    """
    if task.coverage is None:
        return np.asarray(among(on, rows * task.num_cells + cells)[1] * task.detects(cells), float)
    seen = task.sees_by_cell[cells]
    entry = row_index(seen)
    there = among(on, rows[entry] * task.total_sensors + seen.indices)[1]
    # log Π (1 - p) = Σ log(1 - p), in which a sensor that certainly reports gives -inf, and so exactly 1
    with np.errstate(divide="ignore"):
        logs = np.log1p(-seen.data[there])
    return -np.expm1(per_row(entry[there], logs, len(cells)))
