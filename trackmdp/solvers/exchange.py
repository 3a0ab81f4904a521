"""Exchange: change one or two sensors of one set, choose all later sets anew, and only then judge (theory.md#exchange).

Ascent changes one set at a time and stops where two would have to change together: to leave a cell out of one set pays
only if a later set looks for the target where it then may be. So every candidate, the set of step t with one or two
sensors flipped, is held while the sets after it are chosen anew by a forward-and-backward sweep; then sweeps go over
all of its sets, and a candidate of more worth than the plan at hand, in exact expectation, replaces it.

The candidates of all rows are worked on together, as columns (`plans`). With E_t entries at step t and Z successors per
state, a sweep over all H = t_max + 1 steps takes 2 C Z (E_0 + ... + E_H-1) multiplications, C = 33, and the candidates
of the H - 1 steps take about three sweeps each. Some 3 H + 10 arrays of 8 C E bytes are alive at once, E being the
largest E_t of a part: rows are gone through in parts, so that one array holds about `MOST_NUMBERS` numbers, or those of
one row.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from scipy import sparse

from trackmdp.arrays.entries import ranks
from trackmdp.arrays.types import Array, BoolArray, IndexArray
from trackmdp.config.sensors import LARGEST_PRICE
from trackmdp.policies.table import PolicyTable
from trackmdp.seeding import derive
from trackmdp.solvers.bounds import one_set
from trackmdp.solvers.motion_totals import forced_worth
from trackmdp.solvers.plans import Plans, Turn
from trackmdp.solvers.renewal import Renewal
from trackmdp.solvers.search import (
    Found,
    GoOn,
    always,
    ascended,
    clocked_sets,
    follow_credit,
    led,
    mixed,
    risen,
    rows_changed,
)
from trackmdp.world.model import World

MOST_NUMBERS = 2**17
"""Numbers in one array of a part, 1 MB: larger parts leave the caches, and took twice the time."""
SINGLES, PAIRED = 12, 7
"""Sensors of one set that are flipped alone, and how many of these in pairs: those closest to a change first."""
LATER_SWEEPS, ALL_SWEEPS = 1, 2
"""Sweeps over the sets after the flip alone, then over all sets. More of the first gained nothing on drifts and walks;
with one of the second, regrets of .001 to .004 are left there."""
OTHERS, PRICES_OFF, _STEPS, MOST_STARTED = 4, 0.2, 5, 500
"""Other searches from t_max 2 on, how far the prices that lead them are off (standard deviation of their logarithms),
the steps of their homotopies, and the cells up to which they are made. On nine worlds of 9 x 9 and 10 x 10 cells four
gained up to .0007 per step, on diagonal walks .002 to .007, twelve as much again or less; prices .1 or .4 off gained no
more, nor did moves that are off, or 30 steps, for twice the time."""
_ROUNDS = 40
"""Of exchange, at most."""
_SEEN = 1e-12
"""Keys with fewer visits an episode keep their plans: nothing is gained by them."""


def _flips() -> BoolArray:
    """`[SINGLES + 1, C]` whether each candidate flips the sensor of each rank; the last row is for all others."""
    pairs = [*((rank,) for rank in range(SINGLES)), *itertools.combinations(range(PAIRED), 2)]
    flipped = np.zeros((SINGLES + 1, len(pairs)), bool)
    for candidate, places in enumerate(pairs):
        flipped[list(places), candidate] = True
    return flipped


FLIPPED = _flips()


def solve(world: World, starts: int = OTHERS) -> PolicyTable:
    """The policy of `search`, improved by exchange, and from t_max 2 on by the results of `starts` other searches."""
    renewal = Renewal(world, world.motion)
    policy = exchanged(led(renewal))
    if world.num_choices > 2 and renewal.size is not None:
        policy = best_of(policy, other_starts(renewal, starts))
    return policy.table


def improve(world: World, policy: PolicyTable, *, once: bool = False) -> PolicyTable:
    """The result of exchange (`once`: one round of it) from a deterministic `policy`; its AIHTR is no lower."""
    renewal, rounds = Renewal(world, world.motion), 1 if once else _ROUNDS
    start = Found(renewal, renewal.sets(policy))
    return exchanged(start, rounds=rounds).table


def other_starts(
    renewal: Renewal, count: int, steps: int = _STEPS, sweeps: int = 3
) -> Iterator[list[BoolArray]]:
    """The results of `search` with prices a little off; nothing on large grids."""
    world, rng = renewal.world, np.random.default_rng(derive(0, "exchange", "starts"))
    for _ in range(count if world.num_cells <= MOST_STARTED else 0):
        off = np.exp(PRICES_OFF * rng.standard_normal(world.total_sensors))
        other = replace(world, cost=np.minimum(world.cost * off, LARGEST_PRICE))
        changed = renewal.priced_as(other)
        first = Found(changed, clocked_sets(changed))
        yield follow_credit(first, steps, sweeps).sets


def best_of(
    policy: Found,
    others: Iterable[list[BoolArray]],
    *,
    go_on: GoOn = always,
) -> Found:
    """For each key the best plan that exchange makes of `policy`, which has been through it, or of any of the `others`.

    Each key takes a plan of its own, V given, so that with one event a key no value is lower than with `policy`.
    """
    start = policy
    for other in others:
        plans = policy.plans()
        after = plans.ascend(other, sweeps=10)
        # Where these are the plans at hand, exchange has been tried.
        tried = exchange(plans, after, rows_changed(plans.turns, policy.sets, after), go_on)
        worth, other_worth = (plans.worth_of(each) for each in (policy.sets, tried))
        better = other_worth > worth + plans.rounding(worth)
        sets = mixed(plans.turns, better, tried, policy.sets)
        policy = risen(policy, plans, sets) or policy
        if not go_on():
            break
    return policy if policy is start else exchanged(policy, go_on=go_on)


def exchanged(
    policy: Found,
    *,
    go_on: GoOn = always,
    rounds: int = _ROUNDS,
    exact: bool = True,
) -> Found:
    """Policy iteration by exchange, until the AIHTR no longer grows.

    Args:
        policy: where to start.
        go_on: asked before each part whether to look further.
        rounds: at most so many; the first one gains most.
        exact: whether sets of shared sensors are at last the best ones, by linear programs.
    """
    renewal = policy.renewal
    everywhere = np.ones(len(renewal.plans), bool)
    tried = everywhere
    for _ in range(0 if policy.settled else rounds):
        if policy.visits is None:
            plans = renewal.problem(policy.value)
            some = tried & could_gain(plans, policy)
        else:
            plans = renewal.problem(policy.value, policy.visits)
            some = tried & (renewal.by_plan(policy.visits) > _SEEN)
        sets = plans.ascend(policy.sets, sweeps=10)
        sets = exchange(plans, sets, some, go_on)
        better = risen(policy, plans, sets)
        if better is not None:
            # Where nothing was gained nothing is tried again, until the others have settled as well: V has then moved.
            moved = rows_changed(plans.turns, policy.sets, sets)
            policy, tried = better, moved
        elif tried.all():
            policy.settled = go_on()  # else some parts were left out
            break
        else:
            tried = everywhere
        if not go_on():
            break
    return ascended(policy) if exact and renewal.task.coverage is not None else policy


def could_gain(plans: Plans, policy: Found) -> BoolArray:
    """`[K]`, whether a plan is worth less than it could be if the position were revealed after every set."""
    renewal, world = policy.renewal, policy.renewal.world
    if renewal.size is None:
        return np.ones(len(renewal.plans), bool)
    detected = world.reward + policy.value[: world.num_cells]
    most = revealed(world, detected, forced_worth(world, detected), plans.length)
    return hopeful(plans, policy.sets, most)


def hopeful(plans: Plans, sets: Sequence[BoolArray], most: Array) -> BoolArray:
    """`[K]`, whether plans `sets` are worth less than `most` `[K]`."""
    worth = plans.worth_of(sets)
    return most - worth > 10 * plans.rounding(worth)


def revealed(world: World, detected: Array, missed: Array, length: int) -> Array:
    """`[Z]` worth of the best plan if the state were revealed after each set; no plan is worth more."""
    worth = missed
    for _ in range(length):
        worth = one_set(world, detected, worth)
    return worth


def exchange(
    plans: Plans, sets: Sequence[BoolArray], rows: BoolArray, go_on: GoOn = always
) -> list[BoolArray]:
    """Plans worth no less than `sets` to any row; those end where ascent by itself ends.

    Args:
        plans: the problem of each row.
        sets: `[G, 1]` for each step; left as they are.
        rows: `[K]`, the rows of the plans that may change.
        go_on: see `GoOn`.
    """
    improved = [on.copy() for on in sets]
    if plans.length < 2 or not rows.any():  # the last set is always a best answer
        return improved
    for part in itertools.takewhile(lambda _: go_on(), _parts(plans, np.flatnonzero(rows))):
        some, decisions = _cut(plans, part)
        found = _exchanged(some, [on[place] for on, place in zip(improved, decisions, strict=True)])
        for on, place, plan in zip(improved, decisions, found, strict=True):
            on[place] = plan
    return improved


def _parts(plans: Plans, rows: IndexArray) -> Iterator[IndexArray]:
    """The `rows` `[L]` in order, as many at once as `MOST_NUMBERS` allows."""
    # Rows with 40, 50 and 30 entries, and room for 100: their sums 40, 90, 120 fall into the parts 0, 0, 1.
    before, count = plans.turns[0].before, plans.count
    owners = [before, *(turn.rows for turn in plans.turns)]
    entries = np.max([np.bincount(each, minlength=count) for each in owners], axis=0)
    number = (np.cumsum(entries[rows]) - 1) // max(1, MOST_NUMBERS // FLIPPED.shape[1])
    yield from np.split(rows, np.flatnonzero(np.diff(number)) + 1)


def _cut(plans: Plans, rows: IndexArray) -> tuple[Plans, list[IndexArray]]:
    """The plans of some rows, and which decisions are theirs, for each step."""
    some = np.zeros(plans.count, bool)
    some[rows] = True
    number = np.cumsum(some) - 1
    start = now = np.flatnonzero(some[plans.turns[0].before])
    turns, decisions, detected = list[Turn](), list[IndexArray](), list[Array]()
    for turn, worth in zip(plans.turns, plans.detected, strict=True):
        before, now = now, np.flatnonzero(some[turn.rows])
        mine = np.flatnonzero(some[turn.choice.rows])
        moves = turn.moves[before]
        # Moves of these rows lead to entries of theirs alone.
        place = np.searchsorted(now, moves.indices)
        moves = sparse.csr_array((moves.data, place, moves.indptr), shape=(len(before), len(now)))
        owners = number[turn.before[before]], number[turn.rows[now]]
        choice = turn.choice.part(mine, now, rows)
        turns.append(Turn(*owners, moves, turn.stay[before], choice, turn.price[mine]))
        decisions.append(mine)
        detected.append(worth[now, 0])
    return Plans(turns, plans.mass[start, 0], detected, plans.missed[now, 0], plans.unit), decisions


def _exchanged(plans: Plans, sets: Sequence[BoolArray]) -> list[BoolArray]:
    """The better plans `[G, 1]` for each step."""
    plan = list(sets)
    worth = plans.worth(plan)
    for step in range(1, plans.length):
        mass = plans.pushed(plan, step)
        first = plan[step - 1] ^ FLIPPED[_ranks(plans, step, plan, mass)]
        # The sets before the flip are held in these sweeps, so that they need no more than the mass that is left.
        left = plans.missing(step, first, mass)
        later = plans.ascend(plan[step:], mass=left, since=step, sweeps=LATER_SWEEPS)
        every = plans.ascend([*plan[: step - 1], first, *later], sweeps=ALL_SWEEPS)
        plan, worth = _better(plans, plan, worth, every)
    return plan


def _better(
    plans: Plans, plan: list[BoolArray], worth: Array, candidates: list[BoolArray]
) -> tuple[list[BoolArray], Array]:
    """The best candidate of each row in place of its plan, if it is worth more; and its worth."""
    reached = plans.worth(candidates)
    best = reached.argmax(axis=1)[:, None]
    most = np.take_along_axis(reached, best, axis=1)
    gains = most > worth + plans.rounding(worth)
    chosen = []
    for turn, on, old in zip(plans.turns, candidates, plan, strict=True):
        rows, wide = turn.choice.rows, np.broadcast_to(on, (len(on), reached.shape[1]))
        new = np.take_along_axis(wide, best[rows], axis=1)
        chosen.append(np.where(gains[rows], new, old))
    return chosen, np.where(gains, most, worth)


def _ranks(plans: Plans, step: int, plan: list[BoolArray], mass: Array) -> IndexArray:
    """`[G]` how near each decision at `step` is to the other choice, 0 the nearest; SINGLES: never flipped."""
    choice = plans.turns[step - 1].choice
    later = plans.after(plan[step - 1 :], step - 1)[0]
    gain = mass * (plans.detected[step - 1] - later)
    price = plans.priced(step, mass)
    change = np.abs(choice.changes(plan[step - 1], gain, price))
    far = np.full_like(change, np.inf)
    # Free sensors come last: no price would make them nearly worth leaving out.
    with np.errstate(over="ignore"):  # a price near the least of all numbers: far away
        margin = np.divide(change, price, out=far, where=price > 0)[:, 0]
    possible = choice.gained(mass)[:, 0] > 0
    if choice.allowed is not None:
        possible &= choice.allowed[:, 0]
    # Least margin first within each row, the impossible ones last.
    order = np.lexsort((margin, ~possible, choice.rows))
    rank = np.empty(len(order), np.int64)
    rank[order] = np.minimum(ranks(choice.rows), SINGLES)
    return np.where(possible, rank, SINGLES)
