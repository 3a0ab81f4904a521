"""Joint information states of several targets, one by one: exact where they are few (tiny worlds)."""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Callable, Iterator
from typing import TypeAlias

import numpy as np
from scipy import sparse

from trackmdp.arrays.types import Array, IndexArray
from trackmdp.sensing.decisions import report_chance
from trackmdp.solvers.motion_totals import summed_over
from trackmdp.solvers.pomdp import Chain, reached
from trackmdp.solvers.several.beliefs import Beliefs, Clocks
from trackmdp.solvers.several.merging import Rule
from trackmdp.world.group import Group

MOST_STATES = 2_000
"""Joint states up to which a policy is valued exactly: a second or two."""

Known: TypeAlias = tuple[int, int, tuple[tuple[int, float], ...]]
"""A target in the grid: cell of the last detection, misses since, and its belief as pairs of state and mass."""
Joint: TypeAlias = tuple[Known | None, ...]
"""What is known of every target; None of one that has left."""
Outcome: TypeAlias = tuple[float, bool, Known | None]
"""Probability, whether it is a detection, and what is known then."""


def joint_chain(rule: Rule) -> Array | None:
    """`[1, 6]` exact expected totals of a policy from a uniform start.

    None where there are more joint states, or the policy remembers more than beliefs.
    """
    group = rule.group
    starts = (group.states // group.hidden) ** len(group)
    if starts > MOST_STATES or rule.keyed or rule.reads_history:
        return None

    def choices(joint: Joint) -> list[IndexArray]:
        row = [(k, *pair) for k, known in enumerate(joint) if known for pair in known[2]]
        beliefs = Beliefs(*(np.array(part) for part in zip(*row, strict=True)))
        shown = [known or (0, 0, ()) for known in joint]
        located, misses = (np.array([[each[part] for each in shown]]) for part in (0, 1))
        present = np.array([[known is not None for known in joint]])
        return [rule.sets(Clocks(located, misses, present), beliefs.moved(group))]

    chain = explored(group, choices, MOST_STATES)
    if chain is None:
        return None
    if group.task.max_steps is None:
        system = sparse.eye_array(chain.moves.shape[0], format="csc") - chain.moves
        found = sparse.linalg.spsolve(sparse.csc_array(system), chain.totals)
    else:
        found = summed_over(chain.moves, chain.totals, group.task.max_steps)
    return np.asarray(found[:starts].mean(axis=0, keepdims=True))


def explored(
    group: Group, choices: Callable[[Joint], list[IndexArray]], most: int
) -> Chain[Joint] | None:
    """The joint states reached from all starts, which are the first; None where there are more than `most`.

    The totals of a choice, `[6]`, are the expected figures of the step (`GroupEvaluation.totals`).

    Args:
        group: the targets.
        choices: sets of sensors, of which each is followed.
        most: states.
    """
    modes = group.hidden

    def located(state: int) -> Known:
        known = tuple((state + mode, 1.0 / modes) for mode in range(modes))
        return state % group.states // group.modes, 0, known

    def followed(joint: Joint) -> Iterator[tuple[Array, dict[Joint, float]]]:
        forced = any(each and each[1] > group.task.t_max for each in joint)
        for on in [np.arange(0)] if forced else choices(joint):
            total, moves = np.zeros(6), defaultdict[Joint, float](float)
            for chance, after, figures in _steps(group, joint, on, forced):
                total += chance * figures
                if any(after):
                    moves[after] += chance
            yield total, moves

    firsts = [
        range(kind * group.states, (kind + 1) * group.states, modes) for kind in group.targets
    ]
    each = [[located(state) for state in states] for states in firsts]
    return reached(list(itertools.product(*each)), followed, most)


def _steps(
    group: Group, joint: Joint, on: IndexArray, forced: bool
) -> Iterator[tuple[float, Joint, Array]]:
    """Probability, joint state after it and figures of every outcome of a step."""
    task = group.task
    price = task.safe_cost if forced else float(task.paid[on].sum())
    each = [[(1.0, False, None)] if not k else _outcomes(group, k, on, forced) for k in joint]
    for outcome in itertools.product(*each):
        chance = float(np.prod([part[0] for part in outcome]))
        found, after = sum(part[1] for part in outcome), tuple(part[2] for part in outcome)
        inside = sum(part is not None for part in after)
        paid = inside > 0
        reward = task.reward * found - price * paid
        chosen = 0 if forced else len(on)
        yield chance, after, np.array([reward, inside, found, chosen * paid, forced and paid, 1.0])


def _outcomes(group: Group, known: Known, on: IndexArray, forced: bool) -> list[Outcome]:
    """What a step may lead to for one target: located in a state, missed, or gone."""
    task, (located, misses, belief) = group.task, known
    states, masses = (np.array(part) for part in zip(*belief, strict=True))
    moved = Beliefs(np.zeros(len(states), np.int64), states, masses).moved(group)
    cells = group.cell_of(moved.state)
    sees = task.safe_detection[cells] if forced else report_chance(task, on, 0 * cells, cells)
    found: list[Outcome] = []
    shown = moved.state // group.hidden  # the cell, or the state where a detection reveals the mode
    for place in np.unique(shown):
        here = shown == place
        total, known_there = _normal(moved.state[here], moved.mass[here] * sees[here])
        if total > 0:
            found.append((total, True, (int(cells[here][0]), 0, known_there)))
    total, left = _normal(moved.state, moved.mass * (1.0 - sees))
    if total > 1e-15:
        found.append((total, False, (located, min(misses + 1, task.t_max + 1), left)))
    gone = 1.0 - float(moved.mass.sum())
    return [*found, (gone, False, None)] if gone > 1e-15 else found


def _normal(states: IndexArray, mass: Array) -> tuple[float, tuple[tuple[int, float], ...]]:
    """The sum of the masses, and the belief: rounded, so that the same one reached in two ways is one state."""
    total, pairs = float(mass.sum()), zip(states.tolist(), mass.tolist(), strict=True)
    return total, tuple((z, round(p / total, 12)) for z, p in pairs if p > 0)
