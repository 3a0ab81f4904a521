"""Policy iteration over keys: a homotopy from the clocked bound, then ascent (theory.md#search).

The ascent of `plans` ends where no change of one step's set gains, but sets may have to change together: to leave a
cell out pays only if it is looked at next. Starting from the optimistic credit of the clocked bound, r + U(z', 0) -
U(z', n + 1), and moving gradually to the exact one finds most of those joint optima.

Where each plan has one event, as with the paper's keys, a plan of more worth raises the value everywhere. Else it may
lower it for some events, so that a step is kept only if the AIHTR, which is exact, rises
(theory.md#keys-and-hidden-modes).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from typing import TypeAlias

import numpy as np

from trackmdp.arrays.entries import ends_of
from trackmdp.arrays.types import AnyArray, Array, BoolArray, IndexArray
from trackmdp.policies.table import PolicyTable
from trackmdp.solvers.bounds import clocked_table
from trackmdp.solvers.plans import Plans, Turn
from trackmdp.solvers.renewal import Renewal
from trackmdp.solvers.value import visits_of
from trackmdp.world.model import World

_TOGETHER = 1_500
"""Events up to which the changes that raise the AIHTR are found together, by a factorisation."""
_ALONE = 16
"""Else rows to try one by one where no larger part of the changes raises it."""


GoOn: TypeAlias = Callable[[], bool]
"""Asked before each part whether to look further."""


def always() -> bool:
    """A search without a limit."""
    return True


class Found:
    """A policy on a renewal.

    Args:
        renewal: the problem.
        sets: `[G, 1]` bool for each free choice, or the probabilities with which sensors are on.
        near: a policy of about the same value, or such a value `[B]`: where iterations begin.

    Attributes:
        renewal, sets: as given.
        settled: whether exchange has tried all its plans, and found none better.
        visits: `[B]`, of an episode; None where plans have one event each, and nothing depends on them.
        aihtr: mean value of the starts.
        system: of its values.
    """

    def __init__(
        self, renewal: Renewal, sets: Sequence[AnyArray], near: Found | Array | None = None
    ) -> None:
        self.renewal, self.sets, self.settled = renewal, list(sets), False
        self._guess = near.value if isinstance(near, Found) else near
        self.system, self._earned = renewal.system(sets, guessed=self._guess is not None)
        self.visits: Array | None = None
        if renewal.single:
            self.aihtr = float(self.value[renewal.first].mean())
            return
        # The visits alone give the mean value: many policies are judged by it, and few are kept.
        known = near.visits if isinstance(near, Found) else None
        self.visits = visits_of(self.system, renewal.start, known)
        self.aihtr = float(self.visits @ self._earned)

    @cached_property
    def value(self) -> Array:
        """`[B]`."""
        return self.system.solve(self._earned, self._guess)

    @property
    def table(self) -> PolicyTable:
        """The policy of the sets."""
        return self.renewal.table(self.sets)

    def plans(self, credit: Sequence[Array] | None = None, value: Array | None = None) -> Plans:
        """The plans of all keys, each event weighted by its share in the visits of its key.

        The worth of an event is this policy's, or a `value` `[B]`; `credit` is as of `Renewal.problem`.
        """
        weight = None if self.visits is None else self.renewal.shares(self.visits)
        return self.renewal.problem(self.value if value is None else value, weight, credit)

    @property
    def rounding(self) -> float:
        """Gain of AIHTR that is too little to go on for: rounding, or with several events a key a ten-millionth."""
        return (1e-12 if self.visits is None else 1e-7) * float(np.abs(self.value).mean())


def risen(policy: Found, plans: Plans, sets: Sequence[BoolArray]) -> Found | None:
    """The policy with as many of the new plans `sets` as raise the AIHTR; None if none do.

    All of them; else, where keys have several events, those that gain one after another (`_gaining`). Where the system
    is too large for that: the plans of those rows that gain most, half as many each time, and at last some rows alone.
    A few changes alter the visits little, so that their gains are those expected.
    """
    renewal, turns, old = policy.renewal, plans.turns, policy.sets
    moved = rows_changed(turns, old, sets)
    if not moved.any():
        return None
    worth, other = (plans.worth_of(each) for each in (old, sets))
    gain = (other - worth) * _episodes(policy, plans)
    order = np.argsort(-gain, kind="stable")
    order = order[moved[order]]
    if not renewal.single and renewal.count <= _TOGETHER:
        tries = iter([_gaining(policy, sets, order)])
    else:
        tries = _tries(order, alone=not renewal.single)
    for rows in tries:
        # With the visits as they are so little is gained that it would not count: not worth an exact evaluation.
        if not renewal.single and gain[rows].sum() <= policy.rounding:
            continue
        chosen = np.zeros(plans.count, bool)
        chosen[rows] = True
        tried = Found(renewal, mixed(turns, chosen, sets, old), policy)
        if tried.aihtr > policy.aihtr + policy.rounding:
            return tried
    return None


def _gaining(policy: Found, sets: Sequence[BoolArray], order: IndexArray) -> IndexArray:
    """Those rows of `order` whose new plans `sets` raise the AIHTR, after those before them that do.

    With the visits v, the advantage a = b' - (I - T') V of the new plans, and M = I - (T' - T)(I - T)^-1, new plans of
    the events C gain v_C M_CC^-1 a_C. One row more gains the same of what elimination of C leaves of v, M and a.
    """
    assert policy.visits is not None
    renewal = policy.renewal
    owner = renewal.owner[: renewal.normal]
    events = [np.flatnonzero(owner == row) for row in order]
    states = np.concatenate(events)
    system, earned = renewal.system(sets)
    visits, most = policy.visits[states], policy.rounding
    gain = system.residual(earned, policy.value)[states]
    change = np.eye(len(states)) - policy.system.changed(system, states)
    taken = np.zeros(len(order), bool)
    ends = ends_of(np.array([len(each) for each in events]))
    for place, (low, high) in enumerate(itertools.pairwise(ends)):
        here, later = slice(low, high), slice(high, None)
        inverse = np.linalg.inv(change[here, here])
        if visits[here] @ inverse @ gain[here] > most:
            taken[place] = True
            onward, back = change[later, here] @ inverse, change[here, later]
            gain[later] -= onward @ gain[here]
            visits[later] -= visits[here] @ inverse @ back
            change[later, later] -= onward @ back
    return order[taken]


def rows_changed(
    turns: Sequence[Turn], before: Sequence[BoolArray], after: Sequence[BoolArray]
) -> BoolArray:
    """`[K]`, the rows in which the sets differ."""
    found = np.zeros(turns[0].choice.count, bool)
    for turn, old, new in zip(turns, before, after, strict=True):
        found[turn.choice.rows[(old != new)[:, 0]]] = True
    return found


def mixed(
    turns: Sequence[Turn],
    rows: BoolArray,
    these: Sequence[BoolArray],
    others: Sequence[BoolArray],
) -> list[BoolArray]:
    """`[G, 1]` for each free choice: `these` sets in the `rows` `[K]` that are chosen, else the `others`."""
    return [
        np.where(rows[turn.choice.rows, None], this, other)
        for turn, this, other in zip(turns, these, others, strict=True)
    ]


def _tries(order: IndexArray, *, alone: bool) -> Iterator[IndexArray]:
    """All rows of `order`; with `alone` then the first half, quarter, ... of them, and some by themselves."""
    yield order
    if alone:
        yield from (order[: len(order) >> half] for half in range(1, len(order).bit_length()))
        yield from (order[place : place + 1] for place in range(1, min(len(order), _ALONE)))


def _episodes(policy: Found, plans: Plans) -> Array | float:
    """`[K]`, visits of each row in an episode over the mass that `plans` start with there; 1 where not needed."""
    if policy.visits is None:
        return 1.0
    visits = policy.renewal.by_plan(policy.visits)
    mass = (plans.turns[0].starts @ plans.mass)[:, 0]
    # Visits as solved for may be a rounding below 0.
    return np.where(mass > 1e-12, visits / np.maximum(mass, 1e-12), 0.0)


def led(renewal: Renewal, *, steps: int = 30) -> Found:
    """The better one of the clocked policy and the one that the homotopy from it finds in so many `steps`."""
    first = Found(renewal, clocked_sets(renewal))
    after = follow_credit(first, steps)
    return after if after.aihtr >= first.aihtr else first


def credit_of(world: World) -> list[Array]:
    """For each free choice `[Z]`, the credit of the clocked bound: r + U(z', 0) - U(z', n + 1)."""
    table = clocked_table(world).table
    # A report at n misses gains r + U(j, 0) where a miss goes on with U(j, n + 1).
    return list((world.reward + table[:, :1] - table[:, 1:]).T)


def clocked_sets(renewal: Renewal) -> list[BoolArray]:
    """The sets that are best by the clocked credit alone, every event of a key as likely."""
    nothing = np.zeros(renewal.count)
    weight = None if renewal.single else renewal.shares(nothing)
    plans = renewal.problem(nothing, weight, credit_of(renewal.world))
    return plans.ascend(plans.none(), sweeps=1, optimism=1.0)


def follow_credit(
    first: Found,
    steps: int = 30,
    sweeps: int = 3,
    *,
    go_on: GoOn = always,
) -> Found:
    """The homotopy from the clocked bound's credit to the exact one, from the policy `first`, then plain ascent.

    Where values need not rise, from the best policy on the way.
    """
    renewal, world = first.renewal, first.renewal.world
    credit, table = credit_of(world), clocked_table(world).table
    # Value and credit change together: V starts as U(., 0), and is the policy's own from the first step on.
    value = table[renewal.states, 0]
    policy = best = first
    for step in range(steps + 1):
        if not go_on():
            return best
        plans = policy.plans(credit, value)
        sets = plans.ascend(policy.sets, sweeps=sweeps, optimism=1.0 - step / steps)
        # Each step of the homotopy moves few sets, so that the value before is a good guess.
        policy = Found(renewal, sets, policy if step else value)
        value = policy.value
        if renewal.single or policy.aihtr > best.aihtr:
            best = policy
    return ascended(best, go_on=go_on)


def ascended(policy: Found, *, go_on: GoOn = always) -> Found:
    """Policy iteration by ascent, until the AIHTR no longer grows."""
    exact = False
    while go_on():
        plans = policy.plans()
        sets = plans.ascend(policy.sets, sweeps=10, exact=exact)
        better = risen(policy, plans, sets)
        if better is not None:
            policy = better
        elif exact or policy.renewal.task.coverage is None:
            return policy
        else:
            exact = True  # with shared sensors, once good sets gain no more, the best ones may
    return policy
