"""The decisions of a step: the only place that asks for the kind of sensors a task has."""

from __future__ import annotations

from typing import TypeAlias

from trackmdp.arrays.types import IndexArray
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
