"""The exact value of a policy that believes its reports where sensors also report targets that are not there.

Detections are no renewals then: the belief after a report may be wrong. But the sets depend on the believed cell
alone, so pairs (believed cell, true cell) at reports are events as any others (theory.md#false-alarms). The safe action
confirms: it leads to a pair of one cell twice.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy import sparse

from trackmdp.arrays.entries import ends_of, per_row, ranks
from trackmdp.arrays.numbers import REAL
from trackmdp.arrays.types import Array, IndexArray
from trackmdp.errors import UserError
from trackmdp.policies.table import PolicyTable
from trackmdp.solvers.evaluation import Evaluation, pooled
from trackmdp.solvers.events import Events
from trackmdp.solvers.linear import RenewalSystem
from trackmdp.solvers.mass import Passed, passed_last, transition
from trackmdp.solvers.walk import Step, Walk, all_events
from trackmdp.world.model import World
from trackmdp.world.problem import Problem, modelled

_MOST_CELLS = 144
"""Of a grid with false alarms: M² events."""
_DIRECT = 2_000  # events; those of four coordinates fill the factors of a larger system (N = 12: 90 s in place of 5)


def believed(problem: Problem, policy: PolicyTable, false_alarm: float) -> Evaluation:
    """The figures of `policy` if each report is taken for the truth; r is earned where it is true.

    Of several reports the policy believes the likeliest cell, given the misses since the last report.

    Args:
        problem: the problem; `detection` is p_d.
        policy: deterministic, with a plan for each cell.
        false_alarm: p_f, with which a sensor that is on reports the target in a step in which it is not there.

    Raises:
        UserError: there is no motion model or it has modes, p_f is no probability below 1, the grid has more than 144
            cells, episodes are truncated, the safe action may miss, or the policy draws its sets or remembers more
            than the cell.
    """
    world = check_alarms(problem, false_alarm)
    if not policy.deterministic or (policy.task.keyed and not policy.alike):
        raise UserError(
            f"false_alarm={false_alarm}: expected a policy that remembers the cell alone and does not draw its sets"
        )
    m = world.num_cells
    # Event z M + b: the target is in z, and believed in b. Events of one cell twice are the multiples of M + 1.
    events = Events(world.remembering().keys, m, np.arange(m * m))
    walk, mass = Walk(world, world.motion, events), np.ones(m * m)
    onward, gathered = sparse.csr_array((m * m, m * m)), np.zeros((m * m, 6))
    for ranked in _ranked(world, policy):
        found, mass = _reports(world, walk.move(), mass, policy, ranked, false_alarm)
        onward, gathered = onward + found.located, gathered + found.totals
    last = passed_last(world, world.motion, walk.move(), mass)
    system = RenewalSystem(onward + last.located, world.size, direct=_DIRECT)
    gathered += last.totals
    totals = system.solve(gathered)
    error = system.error(gathered, totals, float(totals[:, 5].max()))
    return pooled(totals[:: m + 1].T, error)  # episodes begin believed where they are


def check_alarms(problem: Problem, false_alarm: float) -> World:
    """Return the world if policies can be valued in it with false alarms.

    Raises:
        UserError: see `believed`.
    """
    source = f"false_alarm={false_alarm}"
    world = modelled(problem, source)
    expected = {
        "targets without modes": world.modes == 1,
        "a probability below 1": isinstance(false_alarm, REAL) and 0.0 <= false_alarm < 1.0,
        f"at most {_MOST_CELLS} cells": world.num_cells <= _MOST_CELLS,
        "whole episodes, and a safe action that always locates": world.max_steps is None
        and world.safe,
        "sensors that each cover one cell": world.coverage is None,
    }
    for words, fine in expected.items():
        if not fine:
            raise UserError(f"{source}: expected {words}")
    return world


def _ranked(world: World, policy: PolicyTable) -> Iterator[tuple[IndexArray, IndexArray]]:
    """For each n the sets as (row pointer `[M + 1]`, cells), in each row the likeliest cell first."""
    m, keys = world.num_cells, world.remembering().keys
    walk, mass = Walk(world, world.motion, all_events(world, keys, world.motion)), np.ones(m)
    for n in range(world.num_choices):
        step = walk.move()
        mass = mass @ step.moves
        likely = sparse.csr_array((mass, (step.rows, step.states)), shape=(m, m)).toarray()
        row, cell = np.divmod(np.arange(m * m), m)
        on = np.flatnonzero(policy.chosen(n, row, cell) > 0)
        order = on[np.lexsort((cell[on], -likely.ravel()[on], row[on]))]
        yield np.concatenate([[0], np.cumsum(np.bincount(row[on], minlength=m))]), cell[order]
        mass = mass * (1.0 - policy.sensed_by(world).reports(n, step.rows, step.states))


def _reports(
    world: World,
    step: Step,
    mass: Array,
    policy: PolicyTable,
    ranked: tuple[IndexArray, IndexArray],
    false_alarm: float,
) -> tuple[Passed, Array]:
    """A free choice, as `passed`: the target may be believed in the cell of any sensor that is on.

    Three sensors a b c in this order, the target in b: a is believed with p_f, b with (1 - p_f) p_d, c with
    (1 - p_f)(1 - p_d) p_f; nothing is reported with (1 - p_f)² (1 - p_d).
    """
    m, (pointer, cells) = world.num_cells, ranked
    now, target, believes = mass @ step.moves, step.states, step.rows % m
    # Each entry once for every sensor that is on: with counts 2 0 1, entries 0 0 2 and places 0 1 0 in their sets.
    count = np.diff(pointer)[believes]
    entry = np.repeat(np.arange(len(now)), count)
    place = ranks(entry)
    cell = cells[pointer[believes[entry]] + place]
    # The place of the target's own sensor in the set, beyond its end where that is off.
    own = np.full(len(now), np.iinfo(np.int64).max)
    mine = cell == target[entry]
    own[entry[mine]] = place[mine]
    missed, earlier = 1.0 - world.detection[target], own[entry] < place
    quiet = (1.0 - false_alarm) ** (place - earlier) * np.where(earlier, missed[entry], 1.0)
    first = quiet * np.where(mine, world.detection[target[entry]], false_alarm) * now[entry]
    begins = ends_of(np.bincount(step.rows[entry], minlength=m * m))
    located = transition(first, begins, target[entry] * m + cell, m * m)
    inside = step.summed(now)
    right = per_row(step.rows[entry[mine]], first[mine], m * m)
    spent, sensors = (
        policy.spent(step.n, each)[np.arange(m * m) % m] for each in (world.paid, np.ones(m))
    )
    reward, length = world.reward * right - spent * inside, per_row(step.before, mass, m * m)
    totals = [reward, inside, right, sensors * inside, 0.0 * inside, length]
    seen = own < count
    silent = (1.0 - false_alarm) ** (count - seen) * np.where(seen, missed, 1.0)
    return Passed(located, np.stack(totals, axis=1)), now * silent
