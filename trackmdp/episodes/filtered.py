"""A Bayes filter's policy where sensors also report targets that are not there: its figures, by simulation.

No belief between two safe actions is a point then, so that there is no table of plans, and no exact value. The filter
weighs every report, and every silence of a sensor that is on; the sets are those of the clocked policy
(`solvers/clocked.py`) for the filtered belief. A report declares the likeliest cell where its posterior probability is
`certainty` or more; r is earned where that is true, and n counts on from the last declaration.
"""

from __future__ import annotations

import numpy as np

from trackmdp.seeding import derive
from trackmdp.solvers.alarms import check_alarms
from trackmdp.solvers.bounds import clocked_table
from trackmdp.solvers.recorded import ReplayedTracks
from trackmdp.world.model import Array, BoolArray, World
from trackmdp.world.tracks import Problem

CERTAINTY = 0.9
"""Posterior probability from which a report counts as a detection: a wrong one costs at most the rest of it."""
_NEVER = 1e-12
"""Stands for p_f = 0, so that the evidence of a report is finite."""


def simulate_filter(
    world: Problem, false_alarm: float, episodes: int, *, seed: int = 0, certainty: float = CERTAINTY
) -> ReplayedTracks:
    """What the filter's policy earns and does on independent episodes.

    Args:
        world: the problem; `detection` is p_d.
        false_alarm: p_f, with which a sensor that is on reports the target in a step in which it is not there.
        episodes: how many, all stepped together.
        seed: of the draws.
        certainty: posterior probability of a cell from which a report declares the target there.

    Raises:
        UserError: what `trackmdp.solvers.alarms.believed` refuses as well.
    """
    world = check_alarms(world, false_alarm)
    m, kernel = world.num_cells, world.kernel.toarray()
    edges, table = np.cumsum(kernel, axis=1), clocked_table(world).table
    credit = world.reward + table[:, :1] - table[:, 1:]  # [M, t_max + 1]
    rng = np.random.default_rng(derive(seed, "false_alarm"))
    target, totals, watched = rng.integers(m, size=episodes), np.zeros((6, episodes)), np.zeros(m)
    belief, misses, row = np.eye(m)[target], np.zeros(episodes, dtype=np.int64), np.arange(episodes)
    while len(row):
        moves, chances = rng.random(len(row)), rng.random((len(row), m))
        predicted, forced = belief @ kernel, misses > world.t_max
        gain = predicted * world.detection * credit.T[np.minimum(misses, world.t_max)]
        on = (gain > world.cost * predicted.sum(axis=1, keepdims=True)) & ~forced[:, None]
        target = (moves[:, None] >= edges[target]).sum(axis=1)
        inside = target < m
        there = np.arange(m) == target[:, None]
        reports = on & (chances < np.where(there, world.detection, false_alarm))
        belief = _posterior(world, predicted, on, reports, false_alarm)
        belief[forced] = there[forced]
        declared = forced | (reports.any(axis=1) & (belief.max(axis=1) >= certainty))
        right = declared & inside & (belief.argmax(axis=1) == target)
        price = np.where(forced, world.safe_cost, on @ world.cost)
        counts = (inside, right, on.sum(axis=1) * inside, forced & inside, np.ones(len(row)))
        watched += on[inside].sum(axis=0)
        totals[:, row] += np.stack([world.reward * right - price * inside, *counts])
        misses = np.where(declared, 0, misses + 1)
        row, target, belief, misses = row[inside], target[inside], belief[inside], misses[inside]
    return ReplayedTracks(totals[:5].T, totals[5], watched)


def _posterior(world: World, predicted: Array, on: BoolArray, reports: BoolArray, false_alarm: float) -> Array:
    """`[E, M]` the belief after the reports of the sensors `on`, given that the target is still in the grid.

    All other sensors are as likely to report or not wherever it is: what tells a cell from the others is its own
    sensor, whose report is p_d / p_f times as likely with the target there, and its silence (1 - p_d) / (1 - p_f).
    """
    report = world.detection / max(false_alarm, _NEVER)
    evidence = np.where(reports, report, (1.0 - world.detection) / (1.0 - false_alarm))
    weight = predicted * np.where(on, evidence, 1.0)
    # An exit leaves nothing that could be told of the cell; the episode ends, and the row is not read.
    posterior: Array = weight / np.maximum(weight.sum(axis=1, keepdims=True), 1e-300)
    return posterior
