"""Undetected mass carried through a step: where it is located, at what price, and where it is left."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import sparse

from trackmdp.arrays.entries import index_type, per_row
from trackmdp.arrays.types import Array, IndexArray
from trackmdp.motion.chain import Motion
from trackmdp.sensing.task import Task
from trackmdp.solvers.walk import Step


@dataclass(frozen=True)
class Passed:
    """One step of all B events at once.

    Attributes:
        located: `[B, width]`, probability that this step ends a renewal, and with which event.
        totals: `[B, 6]`, expected reward, steps in the grid, detections, sensors on, safe actions and steps.
    """

    located: sparse.csr_array
    totals: Array


def passed(
    task: Task,
    step: Step,
    mass: Array,
    report: npt.NDArray[np.floating] | float,
    spent: Array | float,
    sensors: Array | float,
) -> tuple[Passed, Array]:
    """Carry undetected mass through a step.

    Args:
        task: its rewards.
        step: the step.
        mass: `[E_before]`, undetected before the move.
        report: `[E]`, probability of a report there.
        spent: `[B]`, price of the sensors on, or D for the safe action.
        sensors: `[B]`, number of sensors on, or 0 for the safe action.

    Returns:
        The step of all events, and the mass `[E]` that is left undetected.
    """
    now = step.back @ mass
    found = now * report
    inside, located = step.summed(now), step.summed(found)
    # Sensors are paid while the target is in the grid, whether or not it is where they look.
    reward, forced = task.reward * located - spent * inside, step.n == task.num_choices
    length = per_row(step.before, mass if step.goes_on is None else mass * step.goes_on, step.count)
    figures = [reward, inside, located, sensors * inside, forced * inside, length]
    onward = transition(found, step.pointer, step.following, step.width)
    if step.missed is not None:
        onward = onward + transition(now - found, step.pointer, step.missed, step.width)
    # Figure by figure in memory: put together, and summed over steps, five times as fast as event by event.
    return Passed(onward, np.array(figures).T), now - found


def passed_last(task: Task, motion: Motion, step: Step, mass: Array) -> Passed:
    """The safe action after the free choices, which leave `mass` `[E_before - begun]` undetected; see `passed`."""
    mass = np.concatenate([mass, np.ones(step.begun)])
    report = 1.0 if task.safe else task.safe_detection[motion.cell[step.states]]
    return passed(task, step, mass, report, task.safe_cost, 0.0)[0]


def transition(
    value: Array, pointer: IndexArray, columns: IndexArray, width: int
) -> sparse.csr_array:
    """`[B, width]` of entries `[E]` in order of their rows, which begin at `pointer`; those of 0 are left out."""
    shape = len(pointer) - 1, width
    some = np.flatnonzero(value > 0)
    if len(some) < len(value):
        value, columns, pointer = value[some], columns[some], np.searchsorted(some, pointer)
    parts = (each.astype(index_type(len(value)), copy=False) for each in (columns, pointer))
    return sparse.csr_array((value, *parts), shape=shape)
