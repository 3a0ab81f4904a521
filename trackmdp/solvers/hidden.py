"""Solving where modes are hidden: the best policy found for the memory asked for, and a bound on every policy.

A plan belongs to a key, which does not determine the state. So an improvement may be a loss for some of the states, no
search is monotone, and several starts are made (theory.md#keys-and-hidden-modes). Two bounds hold for every memory: the
clocked one, and the optimum of a tracker to which a detection reveals the mode as well. That is a standard problem: its
keys are the states.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from operator import attrgetter
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from scipy import sparse

from trackmdp.arrays.entries import per_row, summing
from trackmdp.arrays.types import AnyArray, Array
from trackmdp.policies.table import PolicyTable
from trackmdp.seeding import derive
from trackmdp.solvers import optimal
from trackmdp.solvers.annealing import anneal
from trackmdp.solvers.certify.budget import Budget
from trackmdp.solvers.exchange import exchanged, other_starts
from trackmdp.solvers.linear import accumulate
from trackmdp.solvers.renewal import Renewal
from trackmdp.solvers.search import Found, clocked_sets, follow_credit, mixed
from trackmdp.solvers.solution import OnProgress, SearchProgress, Solution, bracketed
from trackmdp.world.model import World

_STEPS, _SWEEPS = 12, 1
_MORE_EVENTS, _SHARED = 10_000, 8
_MOST_WORK, _CROSSED_WORK = 400_000, 4_000_000
"""What bounds the time: events of all homotopies, and as many of all annealed policies; as how many an event or entry
counts where sensors share cells; entries of the steps of all annealed policies, where these are more, and of crossed
ones."""
_MOST_CROSSED, _MOST_AT_ONCE = 800, 200
"""Crossed policies at most, and those of one search, which more do not improve. On three by three cells crossing gains
up to .003 a step."""
_SHARED_ROUNDS = 2
"""Of exchange, where sensors share cells, whatever the effort."""
_OLD, _ALIKE = 40, 1e-6
"""A search ends after so many policies in a row that were found before, up to this relative difference."""

_worth = attrgetter("aihtr")
Watch: TypeAlias = Callable[[Found, float], bool]
"""Takes the best policy so far and the share of the work that is done; whether to go on."""


class Effort(NamedTuple):
    """How far to search.

    Attributes:
        led: homotopies at most.
        annealed: annealed policies at most.
        least: annealed policies at least; in place of homotopies, where a search takes long.
        crossed: share of the crossed policies.
        rounds: of exchange, for policies from which the best one is made: the first gain most.
    """

    led: int
    annealed: int
    least: int
    crossed: float
    rounds: int


WHOLE, SHORT = Effort(5, 6, 0, 1.0, 20), Effort(4, 4, 2, 0.55, 5)
"""Of `solve`; and for a motion that is estimated: with nine velocities what it found was as good on average, in two
fifths of the time."""


def solve(
    world: World,
    *,
    start: PolicyTable | None = None,
    on_progress: OnProgress = None,
    time_limit: float | None = None,
    tolerance: float = 1e-6,
    **of_bound: Any,
) -> Solution:
    """The best policy found for keys of the world's memory; Ctrl-C ends the search with what it has found.

    Args:
        world: with hidden modes.
        start: a deterministic policy of the same keys that the one found is no worse than.
        on_progress: called after each policy that is searched.
        time_limit: seconds after which the search ends with the best policy so far, and as many for the bound's proof.
        tolerance: bracket that counts as closed, relative to the value.
        **of_bound: further options of the bound's proof, by `optimal.solve`.
    """
    began = time.monotonic()
    best = optimal.solve(revealing(world), time_limit=time_limit, tolerance=tolerance, **of_bound)
    budget, interrupted = Budget(1, time_limit), best.interrupted  # no node is counted here
    search = Search(world, WHOLE, _watching(on_progress, budget, best, began))
    try:
        if not interrupted:
            search.run(start=start)
    except KeyboardInterrupt:
        interrupted = True
    seconds = time.monotonic() - began
    found = bracketed(world, search.best.table, seconds, best.bound, tolerance)
    late = (budget.timed_out or best.timed_out) and not found.certified
    return replace(found, nodes=best.nodes, interrupted=interrupted, timed_out=late)


def _watching(
    on_progress: OnProgress,
    budget: Budget,
    best: Solution,
    began: float,
) -> Watch:
    """Tells of the search below the bound of `best`, until the time is up."""

    def watch(found: Found, share: float) -> bool:
        if on_progress is not None:
            seconds = time.monotonic() - began
            left = min(seconds / share - seconds, budget.seconds) if share else None
            ends = found.aihtr, best.upper, seconds, best.nodes
            on_progress(SearchProgress(*ends, "search, at most", left))
        return budget.left()

    return watch


def best_found(world: World, effort: Effort) -> PolicyTable:
    """The policy of `solve`, without its bound; with less effort one that may be worth less."""
    search = Search(world, effort)
    search.run()
    return search.best.table


class Search:
    """A search for the best policy.

    Args:
        world: with hidden modes.
        effort: how far to search.
        watch: takes the best policy so far and the share of the work that is done; whether to go on.

    Attributes:
        best: the best policy so far; at first the one that homotopies begin from.
    """

    def __init__(self, world: World, effort: Effort, watch: Watch = lambda *_: True) -> None:
        self.world, self.renewal = world, Renewal(world, world.motion)
        self.best = self._first = Found(self.renewal, clocked_sets(self.renewal))
        self._watch, self._done, self._most, self._effort = watch, 0, 1, effort
        # Sets after exchange, by those before: many searches begin from the same ones.
        self._ends: dict[bytes, list[AnyArray]] = {}

    def run(self, *, start: PolicyTable | None = None) -> None:
        """Look for policies from several starts, and cross them; `start` is as of `solve`."""
        count = int(self._effort.crossed * min(_CROSSED_WORK // self._work, _MOST_CROSSED))
        led, hot = self._planned()
        self._most, pool = led + hot + count + (start is not None), list[Found]()
        for policy in self._starts(start, led, hot):
            pool.append(self.searched(policy))
            if not self._goes_on():
                break
        if len(pool) > 1:
            times = -(-count // _MOST_AT_ONCE)
            rng = np.random.default_rng(derive(0, "hidden", "crossed"))
            for _ in range(times):
                self.crossed(pool, count // times, rng)
        if self._goes_on():
            self.best = exchanged(self.best)

    def _goes_on(self) -> bool:
        return self._watch(self.best, self._done / self._most)

    def searched(self, policy: Found) -> Found:
        """After exchange."""
        mark = _bytes(policy.sets)
        if mark in self._ends:
            found = Found(self.renewal, self._ends[mark], policy)
        else:
            rounds = self._effort.rounds if self._slower == 1 else _SHARED_ROUNDS
            found = exchanged(policy, go_on=self._goes_on, rounds=rounds, exact=False)
            self._ends[mark] = self._ends[_bytes(found.sets)] = found.sets
        self._done += 1
        self.best = max(self.best, found, key=_worth)
        return found

    def crossed(self, pool: list[Found], count: int, rng: np.random.Generator) -> list[Found]:
        """A genetic search: `count` times exchange from the plans of two policies, each key's of one of them by chance.

        In the first half a child takes the place of the parent that it is more like (crowding, Mahfoud 1995), so that
        the policies stay different; then that of the policy of the least worth. Ends early where nothing is new.
        """
        worths, old = [each.aihtr for each in pool], 0
        for number in range(count):
            if not self._goes_on():
                break
            pool = sorted(pool, key=_worth, reverse=True)
            # The better one of two, and any other.
            one, another = (
                int(rng.integers(len(pool), size=2).min()),
                int(rng.integers(len(pool) - 1)),
            )
            another += another >= one
            taken = rng.random(len(self.renewal.plans)) < 0.5
            sets = mixed(self.renewal.turns, taken, pool[another].sets, pool[one].sets)
            child = self.searched(Found(self.renewal, sets, pool[one]))
            if _new(child, [each.aihtr for each in pool]):
                like = min((one, another), key=lambda place: _differences(child, pool[place]))
                place = like if number < count // 2 else -1
                pool[place] = max(child, pool[place], key=_worth)
            old = 0 if _new(child, worths) else old + 1
            worths.append(child.aihtr)
            if old == _OLD:
                break
        return pool

    def _planned(self) -> tuple[int, int]:
        """How many homotopies, and annealed policies."""
        effort, least = self._effort, self._effort.least
        more = max(_MORE_EVENTS // (self._slower * self.renewal.count) - 1, 0)
        many = _MOST_WORK // self._work
        led = min(1 + more, effort.led) if many or not least else 0
        return led, min(max(more, many, least), effort.annealed)

    def _starts(self, start: PolicyTable | None, led: int, annealed: int) -> Iterator[Found]:
        """Policies to search from: a known one, those of homotopies, and annealed ones."""
        renewal = self.renewal
        if start is not None:
            yield Found(renewal, renewal.sets(start))
        if led:
            first, go_on = self._first, self._goes_on
            yield follow_credit(first, _STEPS, _SWEEPS, go_on=go_on)
            for sets in other_starts(renewal, led - 1, _STEPS, _SWEEPS):
                yield Found(renewal, sets)
        rng = np.random.default_rng(derive(0, "hidden", "annealed"))
        for place in range(annealed):
            yield anneal(renewal, rng, led=place % 2 == 1)

    @property
    def _work(self) -> int:
        return self._slower * max(
            sum(len(step.rows) for step in [*self.renewal.free, self.renewal.last]), 1
        )

    @property
    def _slower(self) -> int:
        return 1 if self.world.coverage is None else _SHARED


def _bytes(sets: list[AnyArray]) -> bytes:
    return b"".join(each.tobytes() for each in sets)


def _new(policy: Found, worths: list[float]) -> bool:
    """Policies of one worth are mostly the same."""
    return not np.isclose(policy.aihtr, worths, rtol=_ALIKE, atol=0.0).any()


def _differences(one: Found, other: Found) -> int:
    return sum(int((a != b).sum()) for a, b in zip(one.sets, other.sets, strict=True))


def revealing(world: World) -> World:
    """The same target, its mode revealed by each detection; no policy is worth more than the optimum there."""
    return world.but(memory="cell", revealed=world.modes)


def averaged(world: World) -> World:
    """The motion to a tracker that knows of no modes: each cell's moves, averaged over its modes as they occur."""
    if world.modes == 1:
        return world
    of_cell = summing(world.motion.cell, world.num_cells)
    kernel = of_cell @ sparse.diags_array(mode_shares(world)) @ world.kernel @ of_cell.T.tocsr()
    return World.of(world, kernel, memory="cell", revealed=1, markov=True)


def mode_shares(world: World) -> Array:
    """`[Z]` how often each mode occurs in its cell; they add up to 1 in each cell.

    Sensing does not move the target, so the expected visits (I - Q^T)^-1 s of an episode are the same for all policies.
    """
    cell, states = world.motion.cell, world.num_states
    if world.modes == 1:
        return np.ones(states)
    visits = accumulate(sparse.csr_array(world.kernel.T), np.full(states, 1.0 / states))
    return visits / per_row(cell, visits, world.num_cells)[cell]
