"""The picture of an object as plain numbers: a map of the grid, or lines; `drawing` draws them.

One table gives, by an attribute of the object, the function that makes its picture: the package imports no other.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np


@dataclass(frozen=True, eq=False)
class Heat:
    """A number for each cell of a grid.

    Attributes:
        title: in one line.
        values: `[rows, columns]`; nan is left blank.
        label: name and unit of the numbers.
        mark: cells with a frame.
        path: cells that a target visited, in order.
        hollow: `[len(path)]` whether the target was missed there.
    """

    title: str
    values: Any
    label: str
    mark: Sequence[int] = ()
    path: Sequence[int] = ()
    hollow: Sequence[bool] = ()


@dataclass(frozen=True, eq=False)
class Lines:
    """Lines over one axis.

    Attributes:
        title: in one line.
        x: `[N]`.
        lines: name -> `[N]`; nan is left out.
        labels: of x and y.
        levels: name -> height of a horizontal line.
    """

    title: str
    x: Any
    lines: Mapping[str, Any]
    labels: tuple[str, str]
    levels: Mapping[str, float] = field(default_factory=dict)


Picture: TypeAlias = Heat | Lines


def picture_of(shown: Any) -> Picture | None:
    """The picture of an object; None where there is none."""
    for attribute, make in _MAKERS.items():
        if getattr(shown, attribute, None) is not None:
            return make(shown)
    return None


def _episodes(episodes: Any) -> Picture | None:
    """The path of the first target, over the share of steps in which each cell is sensed."""
    if not len(episodes):
        return None
    task, some = episodes.problem.task, episodes[:20]
    steps = sum(len(each) for each in some)
    sensed = sum(task.covered(each.action[~each.forced(task.t_max)]).sum(axis=0) for each in some)
    first = next(some[0].singles())
    # Of several targets one may come later, another one leave before the others.
    path, located = np.append(first.start, first.target), np.append(True, first.located)
    inside = path < task.num_cells
    values = (sensed / steps).reshape(task.size)
    title = "path of the first target; filled: located, hollow: missed"
    label = "share of steps in which a cell is sensed"
    return Heat(title, values, label, (), path[inside].tolist(), (~located[inside]).tolist())


def _run(run: Any) -> Picture:
    """The AIHTR while learning, beside the final figure and the bounds."""
    columns, summary = run.columns, run.summary
    tracks = summary.get("held_out") is not None
    learning = "while learning, validation tracks" if tracks else "while learning"
    lines = {learning: np.array(columns.get("aihtr", ()), float)}  # None becomes nan
    levels = {"learned, held-out tracks" if tracks else "learned": run.evaluation.aihtr}
    for name, part, key in (("Q_MDP", "qmdp", "aihtr"), ("upper bound", "optimal", "upper")):
        if summary.get(part):
            levels[name] = summary[part][key]
    return Lines("learning curve", columns.get("frames", ()), lines, ("frames", "AIHTR"), levels)


def _tradeoff(found: Any) -> Picture:
    """Accuracy against sensors per step."""
    sensors, accuracy = zip(*((each.sensors, each.accuracy) for each in found.corners), strict=True)
    labels = ("sensors per step", "accuracy")
    return Lines("the most accurate policies", sensors, {"policies": accuracy}, labels)


def _solution(solution: Any) -> Picture:
    """The value map."""
    values = solution.value.reshape(solution.table.task.size)
    return Heat("value of the policy by start cell", values, "V(x), reward per episode")


def _policy(policy: Any) -> Picture:
    """The cells sensed after a detection in the middle of the grid, by the number of misses."""
    task = policy.task
    cell = _middle(task)
    values = np.full(task.num_cells, np.nan)
    # From the last n to the first: a cell sensed at several keeps the smallest.
    for n in reversed(range(task.num_choices)):
        on = np.zeros(task.total_sensors, bool)
        on[policy.sensors(int(task.keys.start(cell, 0)), n)] = True
        values[task.covered(on)] = n
    title = "cells sensed after a detection in the framed cell"
    return Heat(
        title, values.reshape(task.size), "misses n after which a cell is sensed first", [cell]
    )


def _tracks(problem: Any) -> Picture:
    """Visits of the recorded tracks."""
    parts = (problem.tracks, problem.validation, problem.held_out)
    cells = np.concatenate([part.cells for part in parts])
    values = np.bincount(cells, minlength=problem.num_cells)
    return Heat("recorded tracks", values.reshape(problem.size), "visits of a cell")


def _motion(world: Any) -> Picture:
    """The cells of a target one step after it was in the middle of the grid."""
    cell, states = _middle(world), world.kernel.shape[0] // world.num_cells
    rows = world.kernel[cell * states : (cell + 1) * states].sum(axis=0) / states
    # State z = cell · H + mode: with H = 2 the states of cell 3 are 6 and 7, added up in one row of the reshaped array.
    values = rows.reshape(world.num_cells, states).sum(axis=1).reshape(world.size)
    return Heat("a target in the framed cell, one step later", values, "probability", [cell])


def _prices(task: Any) -> Picture | None:
    """The prices of the sensors, where there is one in each cell and they differ."""
    if task.coverage is not None or task.cost.min() == task.cost.max():
        return None
    return Heat("price of a sensor", task.cost.reshape(task.size), "price per step")


def _values(evaluation: Any) -> Picture | None:
    """The values of all start cells, in their order."""
    value = np.sort(evaluation.value[np.isfinite(evaluation.value)])
    labels = ("start cells, by value", "V(x), reward per episode")
    return Lines("value by start cell", np.arange(len(value)), {"V(x)": value}, labels)


def _middle(task: Any) -> int:
    return int(task.rows // 2 * task.columns + task.columns // 2)


_MAKERS: dict[str, Callable[[Any], Picture | None]] = {
    "seeds": _episodes,
    "summary": _run,
    "corners": _tradeoff,
    "bound": _solution,
    "starts": _values,
    "deterministic": _policy,
    "kinds": lambda group: picture_of(group.single),
    "held_out": _tracks,
    "kernel": _motion,
    "t_max": _prices,
}
"""An attribute of the objects of one class, and of no class below it -> the function for their picture."""
