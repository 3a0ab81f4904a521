"""Plans on paths, chosen by validation paths: the weight of the prior, and whether to run exchange.

Policy iteration on the counts (`path_counts`) changes one set of a plan given the others, and stops where two would
have to change together. Here the ways on from a key are a tree: after each miss, where the target then was and how
often. Exchange searches whole plans on the trees of all keys that came often enough.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np
from scipy import sparse

from trackmdp.algos.estimates.path_counts import Planned, plan_paths
from trackmdp.algos.estimates.path_gains import (
    AlongPaths,
    KeyPlans,
    Paths,
    along,
    interleaved,
    thinned,
)
from trackmdp.algos.ways import Ways
from trackmdp.arrays.entries import block_rows, ones_at, per_row
from trackmdp.arrays.types import Array, IndexArray
from trackmdp.policies.table import PolicyTable, SetTable
from trackmdp.recordings.tracks import Tracks, shuffled
from trackmdp.seeding import derive
from trackmdp.sensing.task import Task
from trackmdp.solvers.exchange import exchange
from trackmdp.solvers.plans import Plans, sensed, sets_of

PRIORS = (1.0, 3.0, 10.0, 30.0, 100.0)
"""Weights of the prior mean that are tried."""
UNJUDGED = 10.0
"""The weight that is taken where there are no paths to judge by."""
_LEAST = 100
"""Detections of a key, equal paths taken as one, from which its plan is searched: those of rarer keys follow chance."""
_ROUNDS, _LEAST_SHARE, _RISE = 30, 1 / 64, 1e-5
"""Rounds of exchange at most, the smallest share of the keys that are changed at once, and the least rise of reward."""
_SEARCHED, _NEAR = 2, 0.01
"""The best plans, which policy iteration begins from; exchange then from the best result, and from another that earns
less by no more than this share, which it may make up for."""
TRIED, _MOST, _MOST_JUDGED = 200_000, 1_000_000, 600_000
"""Events on which plans are tried, on which the best are searched, and of validation paths: a round takes a second for
a million. On 600,000, which is 40,000 points where the safe action may miss, plans ended up to .01 a step lower."""
_JUDGED = 0.25
"""Share of the recordings that judge, where no others are there for it."""


Maker: TypeAlias = Callable[[Tracks, PolicyTable | None], PolicyTable]
"""Makes a policy of paths; of more paths from the policy that it made of some of them, or None."""


def choose_plan(
    task: Task,
    tracks: Tracks,
    *,
    judge: Tracks | None = None,
    priors: Sequence[float] = PRIORS,
    others: Sequence[Maker] = (),
    discount: float,
    rounds: int = 8,
    seed: int = 0,
) -> Planned:
    """Plan on paths; choose the weight of the prior, and the result of exchange, by reward on validation paths.

    Args:
        task: sensors, prices, limits and memory.
        tracks: the paths; the choice is planned again on all of them, where they have few events enough.
        judge: validation paths; None: paths that `parted` draws from `tracks`, which do not count until all is
            chosen.
        priors: weights of the prior that are tried.
        others: make policies that are tried as they are, and from which policy iteration begins as well.
        discount: γ of the credit.
        rounds: of policy iteration at most.
        seed: of the draw, where there is one.
    """
    counted, judge = parted(tracks, seed) if judge is None else (tracks, judge)
    weights = [*priors, *(UNJUDGED for _ in others)]
    if not len(judge):  # nothing to choose by
        start = None if priors else others[0]
        return _unjudged(Paths(task, tracks, discount), tracks, start, rounds)
    little, enough = (thinned(task, counted, most, seed) for most in (TRIED, _MOST))
    paths = Paths(task, enough, discount)
    few = paths if little is enough else Paths(task, little, discount)
    judged = Paths(task, thinned(task, judge, _MOST_JUDGED, seed), discount)
    tried = [_improved(few, prior, rounds).plans for prior in priors]
    tried += [_made(make, counted, few) for make in others]
    earned = _earned(judged, tried)
    order = np.argsort(-earned, kind="stable")[:_SEARCHED].tolist()
    better = [_improved(paths, weights[place], rounds, tried[place]) for place in order]
    after = _earned(judged, [each.plans for each in better])
    near = _near(after)
    first, found, most = _first(judged, [_searched(better[number]) for number in near])
    plans = [tried[place] for place in order] + [each.plans for each in (*better, found)]
    best = int(np.argmax([*earned[order], *after, most]))
    if counted is tracks or enough is not counted:  # of more paths there were enough already
        return _valued(paths, plans[best].on(paths.keys))
    stage, number = divmod(best, len(order))
    place = order[number if stage < 2 else near[first]]
    whole = Paths(task, thinned(task, tracks, _MOST, seed), discount)
    if stage == 0 and place >= len(priors):  # as it was made
        make = others[place - len(priors)]
        return _valued(whole, _made(make, tracks, whole, plans[best].policy()))
    last = _improved(whole, weights[place], rounds, plans[best])  # from the plan that was chosen
    return _searched(last) if stage == 2 else last


def _unjudged(paths: Paths, tracks: Tracks, start: Maker | None, rounds: int) -> Planned:
    """Policy iteration with the weight that is taken unjudged, from the plan that `start` makes if there is one."""
    if start is None:
        return plan_paths(paths, prior=UNJUDGED, rounds=rounds)
    return _improved(paths, UNJUDGED, rounds, _made(start, tracks, paths))


def _made(make: Maker, tracks: Tracks, paths: Paths, before: PolicyTable | None = None) -> KeyPlans:
    """A plan that `make` makes of `tracks`, with rows of the keys of `paths`."""
    return KeyPlans.of_table(make(tracks, before), paths.keys)


def _improved(paths: Paths, prior: float, rounds: int, start: KeyPlans | None = None) -> Planned:
    """Policy iteration, from `start` if there is one."""
    start = None if start is None else start.on(paths.keys)
    # A recording that was followed ten times is no more evidence than once.
    return plan_paths(paths, prior=prior * paths.copies, rounds=rounds, start=start)


def _earned(judged: Paths, plans: Sequence[KeyPlans]) -> Array:
    """The reward of each of the plans on the judging paths."""
    return np.array([along(judged, each).reward for each in plans])


def _near(earned: Array) -> list[int]:
    """The places of the plans that earn the most, or little less."""
    return np.flatnonzero(earned >= earned.max() - _NEAR * abs(earned.max())).tolist()


def _first(judged: Paths, searched: Sequence[Planned]) -> tuple[int, Planned, float]:
    """The best result of exchange, its place and what it earns on the judging paths.

    The best one by all paths: on those it was made on, each was chosen alike.
    """
    earned = _earned(judged, [each.plans for each in searched])
    first = int(np.argmax(earned + [each.reward for each in searched]))
    return first, searched[first], float(earned[first])


def _valued(paths: Paths, plans: KeyPlans) -> Planned:
    """Plans with their reward on paths."""
    return Planned(plans, along(paths, plans).reward, paths)


def parted(tracks: Tracks, seed: int) -> tuple[Tracks, Tracks]:
    """Paths to learn from and paths to judge by, a quarter of the names; no recording is in both."""
    names = shuffled(tracks.names, derive(seed, "judge"))
    judges = np.isin(tracks.names, names[: round(len(names) * _JUDGED)])
    return tracks.select(~judges), tracks.select(judges)


def _searched(plan: Planned) -> Planned:
    """Rounds of exchange from `plan`; where one raises no reward, half as many keys change, those of largest gain."""
    share, paths, found = 1.0, plan.paths, None
    followed = along(paths, plan.plans)
    for _ in range(_ROUNDS):
        found = found or exchanged_keys(paths, plan.plans.table, followed, _LEAST)
        if found is None:  # no key comes so often
            break
        table = found(share)
        tried = paths.follow(table)
        if tried.reward > plan.reward + _RISE * abs(plan.reward):
            plan = replace(plan, plans=replace(plan.plans, table=table), reward=tried.reward)
            followed, found = tried, None
        elif share > _LEAST_SHARE:
            share /= 2
        else:
            break
    return plan


def exchanged_keys(
    paths: Paths, table: SetTable, followed: AlongPaths, least: int
) -> Callable[[float], SetTable] | None:
    """One round: the plans of keys that a policy came by `least` times or more, on the ways on from them.

    Args:
        paths: all events of the paths.
        table: of the policy, a plan for each key of the paths.
        followed: the policy on the paths.
        least: keys that came less often keep their plans.

    Returns:
        The table by the share of the keys with better plans that change, the ones that gain most: with all changed at
        once visits may change. None where no key came so often.
    """
    arrived = per_row(paths.renewal.owner, followed.visits, len(paths.keys))
    often = np.flatnonzero(arrived >= least)
    if not len(often):
        return None
    plans = _trees(paths, followed, often)
    choices = [turn.choice for turn in plans.turns]
    before = sets_of(choices, table, often)
    found = exchange(plans, plans.ascend(before, sweeps=2), np.ones(len(often), bool))
    gain = plans.worth_of(found) - plans.worth_of(before)
    new = [
        ones_at(*on, (len(often), paths.task.total_sensors))
        for on in sensed(choices, found, np.arange(len(often)))
    ]
    both = sparse.vstack([table.sets, interleaved(new)], format="csr")

    def changed(share: float) -> SetTable:
        few = gain < np.quantile(gain[gain > 0], 1.0 - share) if (gain > 0).any() else gain < 0
        # The plans found are behind those of all keys.
        place = np.arange(len(paths.keys))
        place[often[~few]] = len(place) + np.flatnonzero(~few)
        return SetTable(paths.task, both[block_rows(place, paths.task.num_choices)], len(place))

    return changed


def _trees(paths: Paths, followed: AlongPaths, keys: IndexArray) -> Plans:
    """The ways on from `keys` (places among those seen), each event that is followed being a path (`ways`)."""
    task, renewal = paths.task, paths.renewal
    cells, located = renewal.motion.cell, renewal.keys.cell(renewal.plans[keys])
    number = np.full(len(paths.keys), -1)
    number[keys] = np.arange(len(keys))
    row = number[renewal.owner]
    weight = np.where(row >= 0, followed.visits * paths.times, 0.0)
    ways = Ways(task, located, np.maximum(row, 0), weight, paths.discount)
    start, detected = ways.mass, []

    def mean(events: IndexArray, worth: Array) -> Array:
        """`[E]`, of the events at each entry."""
        return per_row(ways.entry[events], ways.weight[events] * worth, len(ways.mass)) / ways.mass

    for step in renewal.free:
        some = np.flatnonzero(ways.weight[step.rows] > 0)
        ways.choose(*ways.moved(step.rows[some], cells[step.states[some]], task.num_cells))
        detected.append(mean(step.rows[some], task.reward + followed.value[step.following[some]]))
    missed = mean(step.rows, renewal.missed(followed.value))
    return Plans(ways.turns, start, detected, missed, task.reward)
