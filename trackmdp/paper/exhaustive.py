"""Values and bounds of a few cells from their definitions: dense arrays, every plan listed, no code of the solvers.

A target may have modes: the kernel is on states z = cell * H + mode, H being 1 without modes.
"""

from __future__ import annotations

import itertools

import numpy as np

from trackmdp.arrays.types import Array, Indices
from trackmdp.policies.table import PolicyTable
from trackmdp.world.model import World

_SETTLED = 1e-14


def cell_of_state(world: World) -> Indices:
    """`[Z]` the cell of each state of the kernel."""
    return np.arange(world.num_states) // world.modes


def by_cells(world: World, value: Array) -> Array:
    """`[M]` the mean over its modes of `value` `[Z]` in each cell, in which an episode starts in any mode alike."""
    return value.reshape(world.num_cells, -1).mean(axis=1)


def policy_value(world: World, policy: PolicyTable) -> Array:
    """`[M]` value of a policy of the cell, or of the state where detections reveal the mode.

    (state z, key k of the last detection, misses n) is a Markov chain: V = (I - T)^-1 b, with the reward b of a step.
    """
    kernel, cell, sets = world.kernel.toarray(), cell_of_state(world), policy.dense()
    states, keys, clocks = len(kernel), len(sets), world.t_max + 2
    key = cell if keys == world.num_cells else np.arange(states)
    reward = np.zeros((states, keys, clocks))
    moves = np.zeros((states, keys, clocks, states, keys, clocks))
    for k, n in itertools.product(range(keys), range(clocks)):
        if n > world.t_max:
            report, price = world.safe_detection[cell], world.safe_cost
        else:
            report, price = (sets[k, n] * world.detection)[cell], world.cost @ sets[k, n]
        seen = kernel * report
        # Nothing is earned or paid on the exit step (eq. reward_func): kernel.sum(axis=1) is below 1 by the exit.
        reward[:, k, n] = world.reward * seen.sum(axis=1) - price * kernel.sum(axis=1)
        moves[:, k, n, np.arange(states), key, 0] += seen
        moves[:, k, n, :, k, min(n + 1, world.t_max + 1)] += kernel - seen
    size = reward.size
    value = np.linalg.solve(np.eye(size) - moves.reshape(size, size), reward.ravel())
    return by_cells(world, value.reshape(reward.shape)[np.arange(states), key, 0])


def clocked_value(world: World) -> Array:
    """`[M]` the clocked bound by value iteration: the state is revealed after every step, the clock n runs on.

    U(z, n) = sum_j max{sum_z' P [p_d (r + U(z', 0)) + (1 - p_d) U(z', n + 1)] - c_j P_in, sum_z' P U(z', n + 1)} over
    the states z' of cell j; at n = t_max + 1 the safe action replaces the choice, and is repeated until it locates.
    """
    kernel, cell = world.kernel.toarray(), cell_of_state(world)
    of_cell = np.eye(world.num_cells)[cell]
    inside = kernel.sum(axis=1)
    report, safe = world.detection[cell], world.safe_detection[cell]
    table = np.zeros((len(kernel), world.t_max + 2))
    while True:
        before = table.copy()
        located = world.reward + before[:, 0]
        table[:, -1] = kernel @ (safe * located + (1 - safe) * before[:, -1])
        table[:, -1] -= world.safe_cost * inside
        for n in range(world.t_max + 1):
            missed = before[:, n + 1]
            on = (kernel * (report * located + (1 - report) * missed)) @ of_cell
            off = (kernel * missed) @ of_cell
            table[:, n] = np.maximum(on - inside[:, None] * world.cost, off).sum(axis=1)
        if np.abs(table - before).max() <= _SETTLED * max(1.0, np.abs(table).max()):
            return by_cells(world, table[:, 0])


def revealed_value(world: World) -> Array:
    """`[M]` the valid bound: the state is revealed after every step, and a step is a free choice or the safe action.

    V = max{sum_j max{P_j p_d r - c_j P_in, 0}, sum_j P_j p_s r - D P_in} + P V, P_j the moves to cell j.
    """
    kernel, cell = world.kernel.toarray(), cell_of_state(world)
    inside, of_cell = kernel.sum(axis=1), np.eye(world.num_cells)[cell]
    gain = kernel @ of_cell * world.detection * world.reward - inside[:, None] * world.cost
    safe = kernel @ world.safe_detection[cell] * world.reward - world.safe_cost * inside
    best = np.maximum(np.maximum(gain, 0.0).sum(axis=1), safe)
    return by_cells(world, np.linalg.solve(np.eye(len(kernel)) - kernel, best))


def best_worth(world: World, value: Array, mass: Array, sets: int) -> Array:
    """`[B]` the most that `sets` more sets and then the safe action are worth, by trying every set of sensors.

    Args:
        world: without modes.
        value: `[M]`, V of a detection in each cell.
        mass: `[B, M]`, undetected mass before the next move.
        sets: number of free choices left.
    """
    kernel = world.kernel.toarray()
    located = world.reward + value
    if sets == 0:
        safe = world.safe_detection
        after = kernel @ (safe * located) - world.safe_cost * kernel.sum(axis=1)
        # The safe action is repeated until it locates: w = after + P (1 - p_s) w.
        return mass @ np.linalg.solve(np.eye(len(kernel)) - kernel * (1 - safe), after)
    moved = mass @ kernel
    best = np.full(len(mass), -np.inf)
    for bits in itertools.product((0.0, 1.0), repeat=len(kernel)):
        found = moved * (bits * world.detection)
        paid = world.cost @ bits * moved.sum(axis=1)
        rest = best_worth(world, value, moved - found, sets - 1)
        best = np.maximum(best, found @ located - paid + rest)
    return best
