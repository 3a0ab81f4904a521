"""Exchange for plans of keys: sensors are of cells, and where a cell holds several entries they are decided together.

A key's plan is judged on all that may follow the key: hidden states, weighted as the policy's visits distribute them
(`exchanged_pairs`), or the recorded ways on from it (`path_exchange`). What a detection is worth is given, so that
the search for each key stands alone, and is that of `plans`: entries with one key and one cell are a group.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse

from trackmdp.solvers.keyed import KeyedPairs
from trackmdp.solvers.layers import reachable
from trackmdp.solvers.plans import Chains, ChainStep, exchanged_parts, parts
from trackmdp.solvers.renewal import IndexArray
from trackmdp.world.model import Array, BoolArray

_SEEN = 1e-12
"""Keys with fewer visits an episode keep their plans: nothing is gained by them."""


def exchange_chains(chains: Chains, sets: list[BoolArray]) -> list[BoolArray]:
    """Plans `[G]` per step that are worth no less than `sets` to any row."""
    return exchanged_parts(sets, (_cut(chains, part) for part in parts(_entries(chains))), settle=True)


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
            steps.append(ChainStep(layer.rows, layer.moves, worth, world.detection[cell], price, group=group))
            owners.append(np.asarray(np.searchsorted(pairs.groups[n], codes)))
    missed = layers[-1].moves @ worth - world.safe_cost * world.stay_probability[layers[-2].cells]
    return Chains(layers[0].rows, visits[start], steps, missed), owners


def _entries(chains: Chains) -> IndexArray:
    """`[K]` the most entries that each row has at a step."""
    rows = int(chains.rows.max(initial=-1)) + 1
    return np.max([np.bincount(step.rows, minlength=rows) for step in chains.steps], axis=0)


def _cut(chains: Chains, part: slice) -> tuple[Chains, list[IndexArray]]:
    """The searches from the rows of a part, and which groups are theirs, per step."""
    # Rows are in order, so that those of the part are slices.
    ends = (part.start, part.stop)
    kept = [slice(*np.searchsorted(rows, ends)) for rows in (chains.rows, *(step.rows for step in chains.steps))]
    steps, owners = [], []
    for step, before, now in zip(chains.steps, kept, kept[1:], strict=False):
        assert step.group is not None
        owner, group = np.unique(step.group[now], return_inverse=True)
        rows, moves = step.rows[now] - part.start, sparse.csr_array(step.moves[before, now])
        steps.append(ChainStep(rows, moves, step.detected[now], step.chance[now], step.price[owner], group=group))
        owners.append(owner)
    return Chains(chains.rows[kept[0]] - part.start, chains.mass[kept[0]], steps, chains.missed[kept[-1]]), owners
