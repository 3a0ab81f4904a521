"""Exact figures of episodes that are cut after a number of steps (`grid.max_steps`).

Values then depend on the steps left, so the linear solves become backward recursions over them. Nothing diverges where
the target never exits.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from trackmdp.solvers.chains import Evaluation, pool, renewal
from trackmdp.solvers.renewal import per_row, row_index
from trackmdp.world.model import Array, World

__all__ = ["clocked", "evaluate", "valid"]


def evaluate(world: World, chains: npt.NDArray[np.generic]) -> Evaluation:
    """The figures of `chains.evaluate` for episodes of at most `world.max_steps` steps.

    With h steps left, V_h = Σ_t [b_t + L_t V_{h-t}] over the steps t = 1 ... min(h, t_max + 2) after a detection:
    b_t is gathered at step t, and L_t says where the target is located at step t.
    """
    steps = list(renewal(world, chains))
    left = [np.zeros((world.num_cells, 5))]
    for h in range(1, _limit(world) + 1):
        left.append(sum(earned + hit @ left[h - t] for t, (hit, earned) in enumerate(steps[:h], start=1)))
        if h > len(steps):
            left[h - len(steps) - 1] = np.empty((0, 5))
    return pool(left[-1], _length(world))


def valid(world: World) -> Array:
    """`[M]` the valid bound (`bounds.valid`) on episodes of at most `world.max_steps` steps."""
    rows, p = row_index(world.kernel), world.kernel.data
    cost = world.cost[world.kernel.indices] * world.stay_probability[rows]
    free = per_row(rows, np.maximum(p * world.reward - cost, 0.0), world.num_cells)
    best = np.maximum(free, (world.reward - world.safe_cost) * world.stay_probability)
    value = np.zeros(world.num_cells)
    for _ in range(_limit(world)):
        value = best + world.kernel @ value
    return value


def clocked(world: World) -> Array:
    """`[M]` the clocked bound (`bounds.clocked`) on episodes of at most `world.max_steps` steps.

    The optimum over policies that may also depend on the steps left, so a bound for those that may not.
    """
    moves, m = world.kernel, world.num_cells
    rows, cells, p = row_index(moves), moves.indices, moves.data
    cost = world.cost[cells] * world.stay_probability[rows]
    table = np.zeros((m, world.num_choices + 1))
    for _ in range(_limit(world)):
        located = table[cells, 0]
        gains = [
            per_row(rows, np.maximum(p * (world.reward + located) - cost, p * table[cells, n + 1]), m)
            for n in range(world.num_choices)
        ]
        forced = per_row(rows, p * (world.reward - world.safe_cost + located), m)
        table = np.stack([*gains, forced], axis=1)
    return table[:, 0]


def _limit(world: World) -> int:
    """`max_steps` of a world that has one."""
    assert world.max_steps is not None
    return world.max_steps


def _length(world: World) -> Array:
    """`[M]` expected steps of an episode, the exit step included."""
    length = np.zeros(world.num_cells)
    for _ in range(_limit(world)):
        length = 1.0 + world.kernel @ length
    return length
