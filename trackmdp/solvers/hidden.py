"""Solving where modes are hidden: the best policy found for the memory asked for, and a bound on every policy.

A plan belongs to a key, which does not determine the state. So an improvement may be a loss for some of the states, no
search is monotone, and several starts are made (theory.md#keys-and-hidden-modes). Two bounds hold for every memory: the
clocked one, and the optimum of a tracker to which a detection reveals the mode as well. That is a standard problem: its
keys are the states.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from operator import attrgetter
from typing import TypeAlias

import numpy as np

from trackmdp.arrays.types import AnyArray
from trackmdp.policies.table import PolicyTable
from trackmdp.seeding import derive
from trackmdp.solvers import optimal
from trackmdp.solvers.annealing import anneal
from trackmdp.solvers.exchange import exchanged, other_starts
from trackmdp.solvers.renewal import Renewal
from trackmdp.solvers.search import Found, clocked_sets, follow_credit, mixed
from trackmdp.solvers.solution import Solution
from trackmdp.solvers.value import averaged_kernel, value_of
from trackmdp.world.model import World

_STEPS, _SWEEPS = 12, 1
_MORE_EVENTS, _SHARED = 10_000, 8
_MOST_WORK, _CROSSED_WORK = 400_000, 4_000_000
"""What bounds the time: events of all homotopies, and as many of all annealed policies; as how many an event or entry
counts where sensors share cells; entries of the steps of all annealed policies, where these are more, and of crossed
ones."""
_ROUNDS = 20
"""Of exchange, for policies from which the best one is made: the first gain most, and where sensors share cells two."""
_MOST_LED, _MOST_ANNEALED, _MOST_CROSSED, _MOST_AT_ONCE = 4, 6, 800, 200
"""Other homotopies, annealed and crossed policies at most, and crossed ones of one search, which more do not improve.
On three by three cells crossing gains up to .003 a step."""
_OLD, _ALIKE = 40, 1e-6
"""A search ends after so many policies in a row that were found before, up to this relative difference."""

_worth = attrgetter("aihtr")
_Ends: TypeAlias = dict[bytes, list[AnyArray]]
"""Sets after exchange, by those before."""


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
    world: World, *, start: PolicyTable | None = None, annealed: int = 0, effort: float = 1.0
) -> PolicyTable:
    """The policy of `solve`, without its bound.

    Args:
        world: with hidden modes.
        start: as of `solve`.
        annealed: policies to anneal at least; in place of homotopies, where a search takes long.
        effort: share of the policies that are crossed.
    """
    renewal, ends = Renewal(world, world.motion), _Ends()
    pool = [_searched(renewal, each, ends) for each in _starts(renewal, world, start, annealed)]
    if len(pool) > 1:
        count = int(effort * min(_CROSSED_WORK // _work(renewal), _MOST_CROSSED))
        times = -(-count // _MOST_AT_ONCE)
        rng = np.random.default_rng(derive(0, "hidden", "crossed"))
        searches = [_crossed(renewal, pool, count // times, rng, ends) for _ in range(times)]
        pool += [one for each in searches for one in each]
    return renewal.table(exchanged(renewal, max(pool, key=_worth)).sets)


def _searched(renewal: Renewal, policy: Found, ends: _Ends) -> Found:
    """After exchange; its sets are kept, as many searches begin from the same ones."""
    mark = _bytes(policy.sets)
    if mark in ends:
        return Found(renewal, ends[mark], policy)
    found = exchanged(renewal, policy, rounds=_ROUNDS // _slower(renewal), exact=False)
    ends[mark] = ends[_bytes(found.sets)] = found.sets
    return found


def _bytes(sets: list[AnyArray]) -> bytes:
    return b"".join(each.tobytes() for each in sets)


def _crossed(
    renewal: Renewal, pool: list[Found], count: int, rng: np.random.Generator, ends: _Ends
) -> list[Found]:
    """A genetic search: `count` times exchange from the plans of one policy and of another, each key's by chance.

    In the first half a child takes the place of the parent that it is more like (crowding, Mahfoud 1995), so that the
    policies stay different; then that of the policy of the least worth. Ends early where nothing is new.
    """
    worths, old = [each.aihtr for each in pool], 0
    for number in range(count):
        pool = sorted(pool, key=_worth, reverse=True)
        # The better one of two, and any other.
        one, another = int(rng.integers(len(pool), size=2).min()), int(rng.integers(len(pool) - 1))
        another += another >= one
        taken = rng.random(len(renewal.plans)) < 0.5
        sets = mixed(renewal.layout, taken, pool[another].sets, pool[one].sets)
        child = _searched(renewal, Found(renewal, sets, pool[one]), ends)
        if _new(child, [each.aihtr for each in pool]):
            like = min((one, another), key=lambda place: _differences(child, pool[place]))
            place = like if number < count // 2 else -1
            pool[place] = max(child, pool[place], key=_worth)
        old = 0 if _new(child, worths) else old + 1
        if old == _OLD:
            break
        worths.append(child.aihtr)
    return pool


def _new(policy: Found, worths: list[float]) -> bool:
    """Policies of one worth are mostly the same."""
    return not np.isclose(policy.aihtr, worths, rtol=_ALIKE, atol=0.0).any()


def _differences(one: Found, other: Found) -> int:
    return sum(int((a != b).sum()) for a, b in zip(one.sets, other.sets, strict=True))


def _starts(
    renewal: Renewal, world: World, start: PolicyTable | None, least: int
) -> Iterator[Found]:
    """Policies to search from: a known one, those of homotopies, and annealed ones."""
    if start is not None:
        yield Found(renewal, renewal.sets(start))
    more = max(_MORE_EVENTS // (_slower(renewal) * renewal.count) - 1, 0)
    many = _MOST_WORK // _work(renewal)
    if many or not least:
        first = Found(renewal, clocked_sets(renewal, world))
        yield follow_credit(renewal, world, first, _STEPS, _SWEEPS)
        for sets in other_starts(renewal, world, min(more, _MOST_LED), _STEPS, _SWEEPS):
            yield Found(renewal, sets)
    rng = np.random.default_rng(derive(0, "hidden", "annealed"))
    for place in range(min(max(more, many, least), _MOST_ANNEALED)):
        yield anneal(renewal, world, rng, led=place % 2 == 1)


def _work(renewal: Renewal) -> int:
    return _slower(renewal) * max(sum(len(step.rows) for step in renewal.steps), 1)


def _slower(renewal: Renewal) -> int:
    return 1 if renewal.task.coverage is None else _SHARED


def revealing(world: World) -> World:
    """The same target, its mode revealed by each detection; no policy is worth more than the optimum there."""
    return world.but(memory="cell", revealed=world.modes)


def averaged(world: World) -> World:
    """The motion to a tracker that knows of no modes: each cell's moves, averaged over its modes as they occur."""
    if world.modes == 1:
        return world
    kernel = averaged_kernel(world.motion, world.num_cells)
    return World.of(world, kernel, memory="cell", revealed=1, markov=True)
