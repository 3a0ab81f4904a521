"""Solving where modes are hidden: the best policy found for the memory asked for, and a bound on every policy.

A plan belongs to a key, which does not determine the state. So an improvement may be a loss for some of the states, no
search is monotone, and several starts are made (theory.md#keys-and-hidden-modes). Two bounds hold for every memory: the
clocked one, and the optimum of a tracker to which a detection reveals the mode as well. That is a standard problem: its
keys are the states.
"""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np

from trackmdp.arrays.types import BoolArray
from trackmdp.policies.table import PolicyTable
from trackmdp.seeding import derive
from trackmdp.solvers import optimal
from trackmdp.solvers.exchange import best_of, exchanged, other_starts
from trackmdp.solvers.renewal import Renewal
from trackmdp.solvers.search import Found, clocked_sets, follow_credit
from trackmdp.solvers.solution import Solution
from trackmdp.solvers.value import averaged_kernel, value_of
from trackmdp.world.model import World

_STEPS, _SWEEPS = 12, 1
_MOST_EVENTS, _MOST_STARTS = 6_000, 16
"""Events of all searches together, which bounds their time, and searches at most."""
_KICKED_ENTRIES, _MOST_KICKS, _MOST_SHARED, _TAKEN = 900_000, 200, 8, (0.1, 0.2, 0.5)
"""Entries of the steps of all kicks in one order, kicks at most (of sensors that share cells, whose sets take some
times as long), and shares of the keys that one changes. On three by three cells kicks gain up to .001 a step, with the
cell alone in memory and sensors that miss .003."""


def solve(world: World, *, start: PolicyTable | None = None) -> Solution:
    """The best policy found for keys of the world's memory.

    Args:
        world: with hidden modes.
        start: a deterministic policy of the same keys that the one found is no worse than.
    """
    began = time.monotonic()
    table = best_found(world, start=start)
    evaluation = value_of(world, table)
    bound = np.maximum(optimal.solve(revealing(world)).bound, evaluation.value)
    gap = float((bound - evaluation.value).mean())
    certified = gap <= 1e-6 * max(1.0, abs(evaluation.aihtr))
    seconds = time.monotonic() - began
    return Solution(table, evaluation, bound, certified, seconds, nodes=0, interrupted=False)


def best_found(
    world: World, *, start: PolicyTable | None = None, effort: float = 1.0
) -> PolicyTable:
    """The policy of `solve`, without its bound, after so much of its searches and kicks (one search at least)."""
    renewal = Renewal(world, world.motion)
    policies = [exchanged(renewal, each) for each in _starts(renewal, world, start, effort)]
    first = max(policies, key=lambda policy: policy.aihtr)
    others = [policy.sets for policy in policies if policy is not first]
    entries = sum(len(step.rows) for step in renewal.steps)
    most = _MOST_KICKS if world.coverage is None else _MOST_SHARED
    kicks = int(effort * min(most, _KICKED_ENTRIES // max(entries, 1)))
    # Where a search ends depends on the order in which the others are mixed in: with kicks both orders are tried.
    orders = [others, others[::-1]] if kicks and len(others) > 1 else [others]
    best = max(
        (_mixed(renewal, first, each, kicks) for each in orders), key=lambda policy: policy.aihtr
    )
    return renewal.table(best.sets)


def _mixed(renewal: Renewal, best: Found, others: list[list[BoolArray]], kicks: int) -> Found:
    """The best policy with plans of the `others`, key by key, and then after kicks."""
    best = best_of(renewal, best, others)
    return _kicked(renewal, best, others, kicks) if others else best


def _kicked(renewal: Renewal, best: Found, others: list[list[BoolArray]], kicks: int) -> Found:
    """Iterated local search: some keys take the plans of another local optimum, and exchange goes on from there."""
    rng = np.random.default_rng(derive(0, "hidden", "kicks"))
    for _ in range(kicks):
        other = others[rng.integers(len(others))]
        taken = rng.random(len(renewal.plans)) < rng.choice(_TAKEN)
        sets = [
            np.where(taken[choice.rows], new, old)
            for choice, new, old in zip(renewal.choices, other, best.sets, strict=True)
        ]
        tried = exchanged(renewal, Found(renewal, sets))
        best = tried if tried.aihtr > best.aihtr else best
    return best


def _starts(
    renewal: Renewal, world: World, start: PolicyTable | None, effort: float
) -> Iterator[Found]:
    """Policies to search from: a known one, the homotopy, the optimum without modes, all on, none, other homotopies."""
    if start is not None:
        yield Found(renewal, renewal.sets(start))
    count = min(max(int(effort * _MOST_EVENTS) // renewal.count, 1), _MOST_STARTS) - 1
    first = Found(renewal, clocked_sets(renewal, world))
    yield follow_credit(renewal, world, first, _STEPS, _SWEEPS)
    # Homotopies mostly lead to better policies than the rest: of two or three starts all are.
    homotopies = max(count - 3, min(count, 2))
    if count > homotopies:
        for sets in _fixed(renewal, world)[: count - homotopies]:
            yield Found(renewal, sets)
    for sets in other_starts(renewal, world, homotopies, _STEPS, _SWEEPS):
        yield Found(renewal, sets)


def _fixed(renewal: Renewal, world: World) -> list[list[BoolArray]]:
    """Sets of the optimum without modes, of all on where no budget forbids it, and of none."""
    plain = optimal.solve(averaged(world)).table
    cells = renewal.keys.cell(renewal.plans)
    optimum = [
        plain.chosen(n, cells[each.rows], each.sensors) > 0
        for n, each in enumerate(renewal.choices)
    ]
    every = [] if world.budget is not None else [renewal.sets(PolicyTable.all_on(world))]
    return [optimum, *every, renewal.sets(PolicyTable.none(world))]


def revealing(world: World) -> World:
    """The same target, its mode revealed by each detection; no policy is worth more than the optimum there."""
    return world.but(memory="cell", revealed=world.modes)


def averaged(world: World) -> World:
    """The motion to a tracker that knows of no modes: each cell's moves, averaged over its modes as they occur."""
    if world.modes == 1:
        return world
    kernel = averaged_kernel(world.motion, world.num_cells)
    return World.of(world, kernel, memory="cell", revealed=1, markov=True)
