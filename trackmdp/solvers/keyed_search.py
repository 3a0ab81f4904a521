"""Solving for policies that remember a key, against targets with a hidden mode: a bound, a homotopy and exchange."""

from __future__ import annotations

import time

import numpy as np

from trackmdp.policies.table import PolicyTable
from trackmdp.solvers.keyed import KeyedPairs, evaluate_keys
from trackmdp.solvers.keyed_exchange import exchanged_pairs
from trackmdp.solvers.keyed_proof import told_bound
from trackmdp.solvers.renewal import accumulate, check_length, per_row, row_index
from trackmdp.solvers.solution import Solution
from trackmdp.world.model import Array
from trackmdp.world.modes import HiddenWorld

_SETTLED = 1e-10  # of the bound: it is approached from above, so that stopping anywhere is valid


def mode_bound(world: HiddenWorld) -> Array:
    """`[M · H, t_max + 2]` U(z, n), the clocked bound: cell and mode are revealed after every action.

    U(z, n) = sum over cells j of max{ sum over z' in j of P_zz' (p_d (r + U(z', 0)) + (1 - p_d) U(z', n+1)) - c_j P_in,
    sum of P_zz' U(z', n+1) }. It is the fixed point of a monotone map, approached from r · (steps of an episode), which
    is above it: every iterate is a bound.
    """
    kernel, stay = world.kernel, world.stay_probability
    rows, cell = row_index(kernel), kernel.indices // world.modes
    groups, group = np.unique(rows.astype(np.int64) * world.num_cells + cell, return_inverse=True)
    owner, sensor = np.divmod(groups, world.num_cells)
    price, chance = world.cost[sensor] * stay[owner], world.detection[cell]
    steps = accumulate(kernel, np.ones(world.num_states))
    check_length(steps)
    bound = np.tile(world.reward * steps[:, None], (1, world.num_choices + 1))
    while True:
        before = bound.copy()
        found = world.reward + bound[kernel.indices, 0]
        bound[:, -1] = per_row(rows, kernel.data * found, world.num_states) - world.safe_cost * stay
        for n in range(world.num_choices - 1, -1, -1):
            missed = bound[kernel.indices, n + 1]
            on = per_row(group, kernel.data * (chance * found + (1.0 - chance) * missed), len(groups)) - price
            off = per_row(group, kernel.data * missed, len(groups))
            bound[:, n] = per_row(owner, np.maximum(on, off), world.num_states)
        if (before - bound).max() <= _SETTLED * max(1.0, float(np.abs(bound).max())):
            return bound


def cell_bound(world: HiddenWorld) -> Array:
    """`[M]` `mode_bound` just after a detection in each cell, any mode as likely."""
    return _of_cells(world, mode_bound(world))


def _of_cells(world: HiddenWorld, bound: Array) -> Array:
    """`[M]` of a bound `[M · H, t_max + 2]`, at n = 0."""
    mean: Array = bound[:, 0].reshape(world.num_cells, world.modes).mean(axis=1)
    return mean


def solve_keys(world: HiddenWorld, *, start: PolicyTable | None = None, steps: int = 12, rounds: int = 20) -> Solution:
    """A policy over keys by the homotopy from the bound's credit to the exact one, then by exchange.

    Args:
        world: whose `memory` says what a key is.
        start: a policy of the same keys that the one found is no worse than; None: no sensor on.
        steps: of the homotopy.
        rounds: of exchange at most; one is kept only if the exact AIHTR rises.
    """
    began, pairs, bound = time.monotonic(), KeyedPairs(world), mode_bound(world)
    best = pairs.sets(PolicyTable.none(world) if start is None else start)
    value, visits, aihtr = pairs.value(best)
    now = (best, value, visits, aihtr)
    for step in range(-1, steps + 1):
        sets = pairs.improved(*now[:3], bound, 1.0 - max(step, 0) / steps)
        now = (sets, *pairs.value(sets))
        if now[3] > aihtr:
            best, value, visits, aihtr = now
    for _ in range(rounds):
        tried = exchanged_pairs(pairs, best, value, visits)
        found = pairs.value(tried)
        if found[2] <= aihtr + 1e-12 * abs(aihtr):
            break
        best, (value, visits, aihtr) = tried, found
    table = pairs.table(best)
    upper = _of_cells(world, bound)
    evaluation = evaluate_keys(world, table)
    if world.revealed > 1 and (proved := told_bound(pairs, value)) is not None:
        proved = proved.reshape(world.num_cells, -1).mean(axis=1)
        upper = np.maximum(np.minimum(upper, proved), evaluation.value)  # not below what is attained, by rounding
    certified = float(upper.mean()) - evaluation.aihtr <= 1e-6 * max(1.0, abs(evaluation.aihtr))
    return Solution(table, evaluation, upper, certified, time.monotonic() - began, nodes=0, interrupted=False)
