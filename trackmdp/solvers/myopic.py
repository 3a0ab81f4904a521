"""Myopic threshold: sense where the target is likely enough to be next, whatever the costs."""

from __future__ import annotations

from trackmdp.solvers.chains import Prediction, unroll
from trackmdp.solvers.qmdp import TIE
from trackmdp.world.model import BoolArray, World

__all__ = ["solve"]


def solve(world: World, *, threshold: float) -> BoolArray:
    """Chains that sense j iff the predicted probability of j, given the misses so far, is at least `threshold`."""

    def likely(seen: Prediction) -> BoolArray:
        return seen.mass >= threshold * seen.before[seen.rows] * (1.0 - TIE)

    return unroll(world, likely)
