"""Exchange on recorded paths: plans of keys that only change well together, found on what followed each key.

Policy iteration on the counts (`path_counts`) changes one set of a plan given the others, and stops where two would
have to change together. Here a key's recorded ways on are a tree: after each miss, where the target then was and how
often. Exchange searches whole plans on the trees of all keys that came often enough (`keyed_exchange`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import sparse

from trackmdp.policies.table import PolicyTable
from trackmdp.seeding import derive
from trackmdp.solvers.keyed_exchange import exchange_chains
from trackmdp.solvers.path_counts import Planned, plan_paths
from trackmdp.solvers.path_states import AlongPaths, KeyPlans, Paths, sensed_table
from trackmdp.solvers.plans import Chains, ChainStep
from trackmdp.solvers.renewal import IndexArray, per_row, row_index
from trackmdp.world.model import Task
from trackmdp.world.tracks import Tracks, draw_parts

PRIORS = (1.0, 3.0, 10.0, 30.0, 100.0)
"""Weights of what keys share that are tried."""
_UNJUDGED = 10.0
"""The weight that is taken where there are no paths to judge by."""
_LEAST = 100
"""Detections of a key, equal paths taken as one, from which its plan is searched: those of rarer keys follow chance."""
_ROUNDS = 8
_JUDGED = 0.25
"""Share of the recordings that judge, where no others are there for it."""

_OUT_OF_VIEW = 1e18
"""Price of a sensor beyond the window: none is worth it, and times no mass it is still nothing."""


def choose_plan(
    task: Task,
    tracks: Tracks,
    *,
    judge: Tracks | None = None,
    learned: PolicyTable | None = None,
    discount: float,
    rounds: int = 8,
    seed: int = 0,
) -> Planned:
    """A plan with the weight of what keys share, and with exchange or not, as paths say that were not counted.

    Args:
        task: prices, limits and memory.
        tracks: the paths; what was chosen is planned again on all of them.
        judge: paths to choose by; None for those that `parted` draws from `tracks`, which do not count until all is
            chosen.
        learned: a policy to begin with as well, which knows nothing of the paths that judge.
        discount: γ of the credit.
        rounds: of policy iteration at most.
        seed: of the draw, where there is one.
    """
    counted, judge = parted(tracks, seed) if judge is None else (tracks, judge)

    def plan(paths: Paths, prior: float | None) -> Planned:
        if prior is None:
            assert learned is not None
            plans = KeyPlans.of_table(learned, paths.seen)
            return Planned(plans, paths.followed(plans.sets, discount).reward, len(paths.seen), rounds=0)
        return plan_paths(paths, prior=prior, discount=discount, rounds=rounds)

    def score(found: Planned) -> float:
        return judged.followed(found.plans.of(judged.seen), discount).reward

    if not len(judge):  # nothing to choose by
        return plan(Paths(task, tracks), None if learned else _UNJUDGED)
    paths, judged = Paths(task, counted), Paths(task, judge)
    # A recording that was followed ten times is no more evidence than once.
    priors = [*(prior * paths.copies for prior in PRIORS), *([None] if learned else [])]
    plans = [plan(paths, prior) for prior in priors]
    scores = [score(each) for each in plans]
    best = int(np.argmax(scores))
    searched = _searched(paths, plans[best], discount)
    exchange = score(searched) > scores[best]
    if counted is tracks:
        return searched if exchange else plans[best]
    final = plan(whole := Paths(task, tracks), priors[best])
    return _searched(whole, final, discount) if exchange else final


def parted(tracks: Tracks, seed: int) -> tuple[Tracks, Tracks]:
    """Paths to learn from and paths to judge by, a quarter of the names; no recording is in both."""
    count = round(len(np.unique(tracks.names)) * _JUDGED)
    judge, rest = draw_parts(tracks, [count], derive(seed, "judge"))
    return (rest, judge) if count else (tracks, judge)


def _searched(paths: Paths, plan: Planned, discount: float) -> Planned:
    """Rounds of exchange from `plan`; after one that the paths earn no more by, of keys that come twice as often."""
    plans, least = plan.plans, _LEAST
    followed = paths.followed(plans.sets, discount)
    for _ in range(_ROUNDS):
        sets = exchanged_keys(paths, plans.sets, followed, discount, least)
        if sets is plans.sets:  # no key comes so often
            break
        tried = paths.followed(sets, discount)
        if tried.reward > plan.reward:
            plans, followed = replace(plans, sets=sets), tried
            plan = replace(plan, plans=plans, reward=tried.reward, rounds=plan.rounds + 1)
        else:
            least *= 2
    return plan


def exchanged_keys(
    paths: Paths, sets: list[sparse.csr_array], followed: AlongPaths, discount: float, least: int
) -> list[sparse.csr_array]:
    """One round: the plans of keys that a policy came by `least` times or more, on what followed them.

    Args:
        paths: all states of the recorded paths.
        sets: `[keys seen, M]` bool of the policy for each n; left as they are.
        followed: what it earns on the paths.
        discount: γ of the credit.
        least: keys that came less often keep their plans.
    """
    arrived = np.bincount(paths.of_seen[followed.visited], minlength=len(paths.seen))
    often = np.flatnonzero(arrived >= least)
    if not len(often):
        return sets
    chains, owners = _trees(paths, followed, often, discount)
    m = paths.task.num_cells
    places = [(often[owner // m], owner % m) for owner in owners]
    before = [np.asarray(on[place]).ravel() for on, place in zip(sets, places, strict=True)]
    found = exchange_chains(chains, before)
    # The rows of these keys are replaced, those of all others stay.
    stays = np.ones(len(paths.seen), dtype=bool)
    stays[often] = False
    changed = []
    for old, (keys, cells), on in zip(sets, places, found, strict=True):
        kept = stays[rows := row_index(old)]
        rows, columns = (np.concatenate(each) for each in ((rows[kept], keys[on]), (old.indices[kept], cells[on])))
        changed.append(sensed_table(rows, columns, old.shape))
    return changed


def _trees(paths: Paths, followed: AlongPaths, keys: IndexArray, discount: float) -> tuple[Chains, list[IndexArray]]:
    """What followed `keys` (places among those seen), and per step the groups' codes row · M + cell.

    Example: after a key the target was twice in 4 then 5, once in 4 then 6, and once in 7: the first step has the
    entries 4 and 7 with mass 3 and 1, the second 5, 6 and 8 (say) with 2, 1 and 1; 4 moves to 5 with 2/3.
    """
    task, m = paths.task, paths.task.num_cells
    number = np.full(len(paths.seen), -1)
    number[keys] = np.arange(len(keys))
    at = np.flatnonzero(followed.visited & (number[paths.of_seen] >= 0))
    row = number[paths.of_seen[at]]
    count = per_row(row, paths.times[at], len(keys))
    entry, mass, steps, owners = row, count, [], []
    for n in range(task.num_choices):
        there = paths.inside[n, at]
        at, row, entry = at[there], row[there], entry[there]
        cell = paths.cells[n, at]
        # Entries stay in order of their rows: a code begins with the entry before, and that with its row.
        codes, now = np.unique(entry * m + cell, return_inverse=True)
        times = paths.times[at]
        before, arrived = codes // m, per_row(now, times, len(codes))
        # A miss costs a factor γ, as in `Paths.follow`: the move after it carries it.
        weight = arrived / mass[before] * (discount if n else 1.0)
        moves = sparse.csr_array((weight, (before, np.arange(len(codes)))), shape=(len(mass), len(codes)))
        worth = task.reward + discount * followed.value[paths.following[n, at]]
        rows = np.zeros(len(codes), dtype=np.int64)
        rows[now] = row
        owner, group = np.unique(rows * m + codes % m, return_inverse=True)
        price = np.zeros(len(owner))
        price[group[now]] = np.minimum(paths.price[n, at], _OUT_OF_VIEW)
        worth = per_row(now, times * worth, len(codes)) / arrived
        steps.append(ChainStep(rows, moves, worth, np.ones(len(codes)), price, group=group))
        owners.append(owner)
        entry, mass = now, arrived
    forced = task.reward + discount * followed.value[paths.following[-1, at]] - task.safe_cost
    missed = discount * per_row(entry, paths.times[at] * paths.inside[-1, at] * forced, len(mass)) / mass
    return Chains(np.arange(len(keys)), count, steps, missed), owners
