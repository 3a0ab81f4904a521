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

from trackmdp.algos.ways import Ways
from trackmdp.arrays.types import Array, BoolArray, IndexArray
from trackmdp.policies.table import PolicyTable
from trackmdp.sensing.task import Task
from trackmdp.solvers.exchange import exchange
from trackmdp.solvers.plans import Plans, sensed, sets_of

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
        ways = _Paths(task, np.concatenate([draw() for _ in range(_JUDGES)], axis=1), discount)
        before = PolicyTable(task, sets)
        value = ways.value(ways.sets(before))
        after = ways.proposed(before, value)
        judges = (_Paths(task, draw(), discount) for _ in range(_JUDGES))
        gains = np.array([each.gain(before, after, value) for each in judges])
        error = gains.std(axis=0, ddof=1) / np.sqrt(_JUDGES)
        better = np.repeat(gains.mean(axis=0) > _SURE * error, task.num_choices)
        if not better.any():
            break
        kept, taken = (sparse.diags_array(each.astype(float)) for each in (~better, better))
        sets = sparse.csr_array((kept @ sets + taken @ after.sets).astype(bool))
    return sets


class _Paths:
    """The ways on from every key on some paths, put together from moves (`ways`).

    Args:
        task: its sensors and prices.
        paths: `[T+3, B]` keys.
        discount: γ, which every move carries.
    """

    def __init__(self, task: Task, paths: IndexArray, discount: float) -> None:
        self._task, self._count, self._keys = task, task.num_keys, np.arange(task.num_keys)
        # `[E]`, the first key of each entry and its key in each step, the forced one the last.
        self._steps: list[tuple[IndexArray, IndexArray]] = []
        located = task.keys.cell(self._keys)
        ways = Ways(task, located, paths[0], np.ones(paths.shape[1]), discount)
        for keys in paths[1:]:
            inside = np.flatnonzero(keys < self._count)
            self._last, end = ways.moved(inside, keys[inside], self._count)
            self._steps.append((ways.rows, end))
            if len(ways.turns) < task.num_choices:
                ways.choose(self._last, task.keys.cell(end))
        self._turns = ways.turns

    def plans(self, value: Array) -> Plans:
        """The plans of all keys, V `[keys]` given."""
        *detected, missed = (self._task.reward + value[end] for _, end in self._steps)
        missed = self._last @ (missed - self._task.safe_cost)
        return Plans(self._turns, np.ones(self._count), detected, missed, self._task.reward)

    def sets(self, policy: PolicyTable) -> list[BoolArray]:
        """Its decisions here, `[G, 1]` for each free choice."""
        return sets_of((turn.choice for turn in self._turns), policy, self._keys)

    def value(self, sets: list[BoolArray]) -> Array:
        """V `[keys]` of a policy: V = b + K V, K the discounted chance of the key at the next detection."""
        count, plans = self._count, self.plans(np.zeros(self._count))
        chances, mass = list[Array](), plans.mass
        for turn, on in zip(plans.turns, sets, strict=True):
            mass = turn.back @ mass
            chances.append(mass * turn.choice.report(on))
            mass = mass - chances[-1]
        chances.append(self._last.T @ mass)
        *found, last = (
            sparse.csr_array((chance[:, 0], step), shape=(count, count))
            for chance, step in zip(chances, self._steps, strict=True)
        )
        located = sum(found, last)
        earned = plans.worth_of(sets)
        return spsolve(sparse.eye_array(count, format="csc") - located.tocsc(), earned)

    def proposed(self, policy: PolicyTable, value: Array) -> PolicyTable:
        """The policy of the plans that exchange finds."""
        plans = self.plans(value)
        sets = plans.ascend(self.sets(policy), sweeps=2)
        found = exchange(plans, sets, np.ones(self._count, bool))
        return PolicyTable.from_sensed(
            self._task, sensed((turn.choice for turn in self._turns), found, self._keys)
        )

    def gain(self, before: PolicyTable, after: PolicyTable, value: Array) -> Array:
        """`[keys]`, by how much the plans of `after` are worth more, with detections worth V."""
        plans = self.plans(value)
        worth = [plans.worth_of(self.sets(each)) for each in (before, after)]
        return worth[1] - worth[0]
