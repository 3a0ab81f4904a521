"""A Bayes filter's policy where sensors also report targets that are not there: its figures, by simulation.

No belief between two safe actions is a point then, so that there is no table of plans, and no exact value. The filter
weighs every report, and every silence of a sensor that is on. Both of its decisions look one step ahead, the clocked
bound U (`solvers/bounds.py`) as the value of the future. The sets are the clocked policy's for the filtered belief β.
Of the cells reported it declares the likeliest, k, if r β_k + sum_j β_j (U(j, 0) - U(j, n + 1)) > 0: r is earned where
that is true, and n counts on from the last declaration. A wrong one costs nothing by itself, and the belief remains.
"""

from __future__ import annotations

import numpy as np

from trackmdp.arrays.types import Array, BoolArray, IndexArray
from trackmdp.seeding import derive
from trackmdp.sensing.choose import largest
from trackmdp.solvers.bounds import clocked_table
from trackmdp.solvers.evaluation import ReplayedTracks
from trackmdp.solvers.false_alarms import check_alarms
from trackmdp.world.model import World
from trackmdp.world.problem import Problem

_NEVER = 1e-12
"""Stands for p_f = 0, so that the evidence of a report is finite."""


def simulate_filter(
    world: Problem, false_alarm: float, episodes: int, *, seed: int = 0
) -> ReplayedTracks:
    """Totals of the filter's policy on independent episodes.

    Args:
        world: the problem; `detection` is p_d.
        false_alarm: p_f, with which a sensor that is on reports the target in a step in which it is not there.
        episodes: how many, all stepped together.
        seed: of the draws.

    Raises:
        UserError: same as in `trackmdp.solvers.false_alarms.believed`.
    """
    world = check_alarms(world, false_alarm)
    m, kernel = world.num_cells, world.kernel.toarray()
    edges, table = np.cumsum(kernel, axis=1), clocked_table(world).table
    located = (
        table[:, :1] - table[:, 1:]
    ).T  # [t_max + 1, M], worth of knowing the cell over a miss
    rng = np.random.default_rng(derive(seed, "false_alarm"))
    target, totals, watched = rng.integers(m, size=episodes), np.zeros((6, episodes)), np.zeros(m)
    belief, misses, row = np.eye(m)[target], np.zeros(episodes, np.int64), np.arange(episodes)
    while len(row):
        moves, chances = rng.random(len(row)), rng.random((len(row), m))
        predicted, forced = belief @ kernel, misses > world.t_max
        later = located[np.minimum(misses, world.t_max)]
        gain = predicted * world.detection * (world.reward + later)
        price = world.prices * predicted.sum(axis=1, keepdims=True)
        on = (gain > price) & ~forced[:, None]
        if world.budget is not None:
            net, each = (gain - price).reshape(-1, 1), np.repeat(np.arange(len(row)), m)
            on &= largest(each, net, world.budget).reshape(on.shape)
        target = (moves[:, None] >= edges[target]).sum(axis=1)
        inside = target < m
        there = np.arange(m) == target[:, None]
        reports = on & (chances < np.where(there, world.detection, false_alarm))
        belief = _posterior(world, predicted, on, reports, false_alarm)
        belief[forced] = there[forced]
        declared, cell = _declared(world.reward, belief, reports, later)
        right = inside & (forced | (declared & (cell == target)))
        declared |= forced
        spent = np.where(forced, world.safe_cost, on @ world.paid)
        counts = (inside, right, on.sum(axis=1) * inside, forced & inside, np.ones(len(row)))
        watched += on[inside].sum(axis=0)
        totals[:, row] += np.stack([world.reward * right - spent * inside, *counts])
        misses = np.where(declared, 0, misses + 1)
        row, target, belief, misses = row[inside], target[inside], belief[inside], misses[inside]
    return ReplayedTracks(totals[:5].T, totals[5], watched)


def _declared(
    reward: float, belief: Array, reports: BoolArray, later: Array
) -> tuple[BoolArray, IndexArray]:
    """`[E]` whether to declare the likeliest of the cells that reported, and `[E]` which it is.

    Args:
        reward: r.
        belief: `[E, M]`, after the reports.
        reports: `[E, M]`.
        later: `[E, M]`, worth of the target located in each cell over a miss.
    """
    likely = np.where(reports, belief, 0.0)
    worth = reward * likely.max(axis=1) + (belief * later).sum(axis=1)
    return reports.any(axis=1) & (worth > 0), likely.argmax(axis=1)


def _posterior(
    world: World, predicted: Array, on: BoolArray, reports: BoolArray, false_alarm: float
) -> Array:
    """`[E, M]` the belief after the reports of the sensors `on`, given that the target is still in the grid.

    All other sensors report independently of it: the evidence for a cell comes from its own sensor, with a report
    p_d / p_f times as likely with the target there, and silence (1 - p_d) / (1 - p_f) times.
    """
    report = world.detection / max(false_alarm, _NEVER)
    evidence = np.where(reports, report, (1.0 - world.detection) / (1.0 - false_alarm))
    weight = predicted * np.where(on, evidence, 1.0)
    # After an exit there is no cell; the episode ends, and the row is not read.
    return weight / np.maximum(weight.sum(axis=1, keepdims=True), 1e-300)
