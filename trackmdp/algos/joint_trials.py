"""Trials: joint changes of a policy's sets, proposed on some paths and accepted on others.

Nets learn each set given the others, and end where two sets would have to change together: to leave a cell out pays
only if a later set looks for the target where it then may be. Exchange (`solvers/exchange.py`) proposes such plans, on
paths put together from sensed moves. New paths judge: a key takes its proposal only where that gains clearly more than
chance, so that the proposals' fit to their own paths does not count.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import spsolve

from trackmdp.arrays.types import Array, BoolArray, IndexArray
from trackmdp.policies.table import PolicyTable
from trackmdp.sensing.decisions import sensing
from trackmdp.sensing.task import Task
from trackmdp.solvers.exchange import exchange
from trackmdp.solvers.plans import Layout, Plans, Turn
from trackmdp.solvers.search import candidates_of, columns_of

_ROUNDS, _JUDGES, _SURE = 3, 10, 3.0
"""Rounds at most; batches of paths that judge; standard errors of its gain that a proposal has to exceed."""


def tried(
    task: Task, sets: sparse.csr_array, draw: Callable[[], IndexArray], discount: float
) -> sparse.csr_array:
    """`sets` `[keys * (T+1), S]` of a policy with the proposals that were accepted in their place.

    Args:
        task: one whose safe action never misses.
        sets: learned.
        draw: gives a batch of new paths, `[T+3, B]` keys, the number of keys once outside.
        discount: γ of the values.
    """
    for _ in range(_ROUNDS):
        ways = _Ways(task, np.concatenate([draw() for _ in range(_JUDGES)], axis=1), discount)
        before = PolicyTable(task, sets)
        value = ways.value(ways.sets(before))
        after = ways.proposed(before, value)
        judges = (_Ways(task, draw(), discount) for _ in range(_JUDGES))
        gains = np.array([each.gain(before, after, value) for each in judges])
        error = gains.std(axis=0, ddof=1) / np.sqrt(_JUDGES)
        better = np.repeat(gains.mean(axis=0) > _SURE * error, task.num_choices)
        if not better.any():
            break
        kept, taken = (sparse.diags_array(each.astype(float)) for each in (~better, better))
        sets = sparse.csr_array((kept @ sets + taken @ after.sets).astype(bool))
    return sets


class _Ways:
    """The ways on from every key on some paths, equal beginnings taken as one.

    Example: from a key the target was twice in 4 then 5, once in 4 then 6, and once in 7: the first step has the
    entries 4 and 7 with probability 3/4 and 1/4, the second 5, 6 and 8 (for instance); 4 moves to 5 with 2/3.

    Args:
        task: its sensors and prices.
        paths: `[T+3, B]` keys.
        discount: γ, which every move carries.
    """

    def __init__(self, task: Task, paths: IndexArray, discount: float) -> None:
        self._task, self._ends, self._count = task, list[IndexArray](), task.num_keys
        rows, entry, turns = np.arange(self._count), paths[0], list[Turn]()
        located = task.keys.cell(rows)
        for step in range(1, len(paths)):
            number = len(rows)
            arrived = np.bincount(entry, minlength=number)
            inside = paths[step] < self._count
            paths, entry = paths[:, inside], entry[inside]
            codes, now, mass = np.unique(
                entry * self._count + paths[step], return_inverse=True, return_counts=True
            )
            begun, end = np.divmod(codes, self._count)
            chance = discount * mass / arrived[begun]
            if step == len(paths) - 1:
                self._last = sparse.csr_array((chance, (begun, end)), shape=(number, self._count))
                break
            moves = sparse.csr_array(
                (chance, (begun, np.arange(len(codes)))), shape=(number, len(codes))
            )
            rows, entry = rows[begun], now
            choice = sensing(task, rows, task.keys.cell(end), self._count, located)
            turns.append(Turn(rows, moves, moves.sum(axis=1), choice, task.prices[choice.sensors]))
            self._ends.append(end)
        self._layout = Layout(np.arange(self._count), turns, self._count)

    def plans(self, value: Array) -> Plans:
        """The plans of all keys, V `[keys]` given."""
        task = self._task
        worth = task.reward + value
        missed = self._last @ (worth - task.safe_cost)
        return Plans(self._layout, np.ones(self._count), [worth[end] for end in self._ends], missed)

    def sets(self, policy: PolicyTable) -> list[BoolArray]:
        """Its decisions here, `[G]` for each free choice."""
        choices = (turn.choice for turn in self._layout.turns)
        return [policy.chosen(n, each.rows, each.sensors) > 0 for n, each in enumerate(choices)]

    def value(self, sets: list[BoolArray]) -> Array:
        """V `[keys]` of a policy: V = b + K V, K the discounted chance of the key at the next detection."""
        count, plans = self._count, self.plans(np.zeros(self._count))
        chances, mass = [], plans.mass
        for turn, end, on in zip(plans.turns, self._ends, candidates_of(sets), strict=True):
            mass = turn.back @ mass
            found = mass * turn.choice.report(on)
            chances.append(sparse.csr_array((found[:, 0], (turn.rows, end)), shape=(count, count)))
            mass = mass - found
        last = (turn.rows, np.arange(len(mass)))
        rows = sparse.csr_array((mass[:, 0], last), shape=(count, len(mass)))
        located = sum(chances, rows @ self._last)
        earned = plans.worth_of(sets)
        return spsolve(sparse.eye_array(count, format="csc") - located.tocsc(), earned)

    def proposed(self, policy: PolicyTable, value: Array) -> PolicyTable:
        """The policy of the plans that exchange finds."""
        plans = self.plans(value)
        sets = columns_of(plans.ascend(candidates_of(self.sets(policy)), sweeps=2))
        found = exchange(plans, sets, np.ones(self._count, dtype=bool))
        choices = (turn.choice for turn in plans.turns)
        return PolicyTable.from_sensed(
            self._task, [(c.rows[on], c.sensors[on]) for c, on in zip(choices, found, strict=True)]
        )

    def gain(self, before: PolicyTable, after: PolicyTable, value: Array) -> Array:
        """`[keys]`, by how much the plans of `after` are worth more, with detections worth V."""
        plans = self.plans(value)
        worth = [plans.worth_of(self.sets(each)) for each in (before, after)]
        return worth[1] - worth[0]
