"""Myopic threshold: sense where the target is likely enough to be next, whatever the costs."""

from __future__ import annotations

import numpy as np

from trackmdp.policies.table import PolicyTable
from trackmdp.solvers import qmdp
from trackmdp.solvers.cover import Offer
from trackmdp.solvers.prediction import Prediction, unroll
from trackmdp.world.model import World


def solve(world: World, *, threshold: float | None = None) -> PolicyTable:
    """Sense j iff the probability that it reports the target, given the misses so far, is at least `threshold`.

    Without one, sense where the sensor earns its price in this very step: p_d(j) p_j r >= c_j p_in.
    """
    if threshold is None:
        return qmdp.solve(world, in_grid=True)

    # The threshold is as a price, the same of all sensors.
    limit = np.full(world.total_sensors, threshold)

    def likely(seen: Prediction) -> Offer:
        return Offer(seen.mass * world.detects(seen.cells), limit, seen.before, ties=True)

    return unroll(world, likely)
