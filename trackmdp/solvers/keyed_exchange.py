"""Exchange for plans of keys: sensors are of cells, and where a cell holds several entries they are decided together.

A key's plan is judged on all that may follow the key: hidden states, weighted as the policy's visits distribute them
(`exchanged_pairs`), or the recorded ways on from it (`path_exchange`). What a detection is worth is given, so that
the search for each key stands alone, and is that of `exchange.PlansPart` but for the groups: entries with one key and
one cell are switched on together, and paid for once.

Example: a key whose target may have moved to cell 5 with heading 0 or 1, or to cell 6: three entries, the groups 0 0 1.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from trackmdp.solvers.exchange import FLIPPED, MOST_NUMBERS, SINGLES, PlansPart, ranked, summing
from trackmdp.solvers.keyed import KeyedPairs
from trackmdp.solvers.layers import reachable
from trackmdp.solvers.renewal import IndexArray, per_row, row_index
from trackmdp.world.model import Array, BoolArray

_SEEN = 1e-12
"""Keys with fewer visits an episode keep their plans: nothing is gained by them."""


@dataclass(frozen=True)
class ChainStep:
    """Where the target may be after a free choice's move, E entries in order of their rows, in G groups.

    Attributes:
        rows: `[E]`, which row's plan, 0 ... K - 1.
        moves: `[E_before, E]`, probability of each move.
        detected: `[E]`, what locating the target there is worth.
        chance: `[E]`, p_d of the sensor there.
        group: `[E]`, the sensor that decides it; groups are in order of their rows.
        price: `[G]`.
    """

    rows: IndexArray
    moves: sparse.csr_array
    detected: Array
    chance: Array
    group: IndexArray
    price: Array


@dataclass(frozen=True)
class Chains:
    """The searches from K rows.

    Attributes:
        rows: `[E_0]`, the row of each entry before any move, in order.
        mass: `[E_0]`, its weight.
        steps: of the free choices.
        missed: `[E]`, what is left where the target was missed in the last step.
    """

    rows: IndexArray
    mass: Array
    steps: list[ChainStep]
    missed: Array


def exchange_chains(chains: Chains, sets: list[BoolArray]) -> list[BoolArray]:
    """Plans `[G]` per step that are worth no less than `sets` to any row."""
    improved = [on.copy() for on in sets]
    for low, high in _parts(chains):
        part = _GroupedPart(chains, low, high)
        plans = part.exchange([on[each] for on, each in zip(improved, part.owners, strict=True)])
        for on, owner, plan in zip(improved, part.owners, plans, strict=True):
            on[owner] = plan
    return improved


def exchanged_pairs(pairs: KeyedPairs, sets: list[BoolArray], value: Array, visits: Array) -> list[BoolArray]:
    """Plans that are worth no less to any key, `value` and `visits` given; together they may be worth less.

    Args:
        pairs: of keys and hidden modes.
        sets: a bool for each group of `pairs`, per step; left as they are.
        value: `[B]` V of `sets`.
        visits: `[B]` of an episode.
    """
    chains, owners = _of_pairs(pairs, value, visits)
    improved = [on.copy() for on in sets]
    plans = exchange_chains(chains, [on[owner] for on, owner in zip(sets, owners, strict=True)])
    for on, owner, plan in zip(improved, owners, plans, strict=True):
        on[owner] = plan
    return improved


def _of_pairs(pairs: KeyedPairs, value: Array, visits: Array) -> tuple[Chains, list[IndexArray]]:
    """The searches of all visited keys, and which of the groups of `pairs` theirs are, per step."""
    world, h = pairs.world, pairs.world.modes
    start = np.flatnonzero(visits > _SEEN)
    # Row k of the search is the k-th key that is visited.
    visited, rows = np.unique(pairs.key[start], return_inverse=True)
    layers = reachable(world.kernel, pairs.state[start], world.num_choices + 1, rows=rows.astype(np.int64))
    steps, worth = [], np.zeros(0)
    owners: list[IndexArray] = []
    for n, layer in enumerate(layers[1:]):
        cell, key = layer.cells // h, visited[layer.rows]
        worth = world.reward + value[pairs.after(key, n, layer.cells)]
        codes, group = np.unique(key * world.num_cells + cell, return_inverse=True)
        if n < world.num_choices:
            price = world.cost[codes % world.num_cells]
            steps.append(ChainStep(layer.rows, layer.moves, worth, world.detection[cell], group, price))
            owners.append(np.asarray(np.searchsorted(pairs.groups[n], codes)))
    missed = layers[-1].moves @ worth - world.safe_cost * world.stay_probability[layers[-2].cells]
    return Chains(layers[0].rows, visits[start], steps, missed), owners


def _parts(chains: Chains) -> Iterator[tuple[int, int]]:
    """Ranges of rows, so many at once that an array of all candidates holds about `MOST_NUMBERS` numbers."""
    rows = int(chains.rows.max(initial=-1)) + 1
    entries = np.max([np.bincount(step.rows, minlength=rows) for step in chains.steps], axis=0)
    number = (np.cumsum(entries) - 1) // max(1, MOST_NUMBERS // FLIPPED.shape[1])
    ends = np.concatenate([[0], np.flatnonzero(np.diff(number)) + 1, [rows]])
    yield from ((int(low), int(high)) for low, high in itertools.pairwise(ends) if high > low)


class _GroupedPart(PlansPart):
    """The plans of the rows `low` ... `high` - 1 and their candidates.

    Attributes:
        owners: per step `[G]`, the groups of these rows.
    """

    def __init__(self, chains: Chains, low: int, high: int) -> None:
        # Rows are in order, so that those of the part are slices; index 0 of each list is the layer before any move.
        kept = [slice(*np.searchsorted(rows, (low, high))) for rows in (chains.rows, *(s.rows for s in chains.steps))]
        self.length = len(chains.steps)
        self.rows = [chains.rows[kept[0]] - low, *(s.rows[k] - low for s, k in self._pairs(chains, kept))]
        self.moves = [
            sparse.csr_array((0, 0)),
            *(
                sparse.csr_array(s.moves[before, now])
                for s, before, now in zip(chains.steps, kept, kept[1:], strict=False)
            ),
        ]
        self.back = [sparse.csr_array(moves.T) for moves in self.moves]
        self.sums = [summing(rows, high - low) for rows in self.rows]
        self.stay = [per_row(row_index(m), m.data, m.shape[0])[:, None] for m in self.moves[1:]]
        self.detected, self.reports = (
            [np.zeros((0, 1)), *(np.asarray(each)[k][:, None] for each, k in zip(column, kept[1:], strict=True))]
            for column in ([s.detected for s in chains.steps], [s.chance for s in chains.steps])
        )
        self.owners, self.group, self.adding, self.cost = (
            [],
            [np.zeros(0, dtype=np.int64)],
            [sparse.csr_array((0, 0))],
            [np.zeros((0, 1))],
        )
        for step, k in self._pairs(chains, kept):
            owner, first, group = np.unique(step.group[k], return_index=True, return_inverse=True)
            # A group is paid for once: its first entry bears the price, the others none.
            cost = np.zeros(len(group))
            cost[first] = step.price[owner]
            self.owners.append(owner)
            self.group.append(group)
            self.adding.append(summing(group, len(owner)))
            self.cost.append(cost[:, None])
        self.missed = chains.missed[kept[-1]][:, None]
        self.allowed = [None] * (self.length + 1)
        self.mass = chains.mass[kept[0]][:, None]

    @staticmethod
    def _pairs(chains: Chains, kept: list[slice]) -> Iterator[tuple[ChainStep, slice]]:
        yield from zip(chains.steps, kept[1:], strict=True)

    def exchange(self, sets: list[BoolArray]) -> list[BoolArray]:
        """The better plans `[G]` per step, from the `sets` of the same groups."""
        plan = [on[group][:, None] for on, group in zip(sets, self.group[1:], strict=True)]
        plan, _ = self.better(plan, self.worth(plan), self.ascend(plan, self.mass, 0, 2))
        found = super().exchange([on[:, 0] for on in plan])
        return [np.asarray(adding @ on > 0) for adding, on in zip(self.adding[1:], found, strict=True)]

    def best(self, t: int, mass: Array, gain: Array) -> BoolArray:
        """`[E, C]`, alike within a group: what it gains in all its entries, against its price."""
        price = (self.adding[t] @ self.cost[t])[self.group[t]]
        on: BoolArray = (self.adding[t] @ (mass * gain))[self.group[t]] > price * (self.sums[t] @ mass)[self.rows[t]]
        return on

    def ranks(self, step: int, plan: list[BoolArray], mass: Array) -> IndexArray:
        """`[E]`, alike within a group: how near its choice is to the other one."""
        adding, group = self.adding[step], self.group[step]
        gain = self.reports[step] * (self.detected[step] - self.undetected(plan[step:], step)[0])
        gained, there = (adding @ (mass * each) for each in (gain, 1.0))
        row = np.zeros(adding.shape[0], dtype=np.int64)
        row[group] = self.rows[step]
        price = (adding @ self.cost[step]) * (self.sums[step] @ mass)[row]
        margin = np.divide(np.abs(gained - price), price, out=np.full_like(gained, np.inf), where=price > 0)[:, 0]
        possible = there[:, 0] > 0
        rank: IndexArray = np.where(possible, np.minimum(ranked(row, margin, possible), SINGLES), SINGLES)[group]
        return rank
