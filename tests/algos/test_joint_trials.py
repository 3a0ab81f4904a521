"""Trials: joint changes that single sets cannot find, accepted where other paths show a clear gain."""

from __future__ import annotations

import numpy as np

import trackmdp as tm
from tests.solvers.worlds import searched
from trackmdp.algos import joint_trials
from trackmdp.algos.joint_trials import tried
from trackmdp.policies.table import PolicyTable

WALK = tm.make_world("random_walk", size=4).but(cost=0.4, safe_cost=None)
"""Leaving a neighbour out at n = 0 pays only if n = 1 looks where the target then is."""


class Draws:
    """Paths of the target, an equal number from each cell."""

    def __init__(self, world: tm.World, each: int) -> None:
        exits = 1.0 - world.kernel.sum(axis=1)
        table = np.column_stack([world.kernel.toarray(), exits])
        self._sums = np.vstack([table.cumsum(axis=1), np.ones(table.shape[1])])
        self._sums[-1, :-1] = 0.0  # outside for good
        self._world, self._each, self._rng = world, each, np.random.default_rng(0)

    def __call__(self) -> np.ndarray:
        cells = [np.repeat(np.arange(self._world.num_cells), self._each)]
        for _ in range(self._world.t_max + 2):
            draw = self._rng.random(len(cells[-1]))[:, None]
            outside = self._world.num_cells
            cells.append(np.minimum((self._sums[cells[-1]] <= draw).sum(axis=1), outside))
        return np.stack(cells)


def worth(table: PolicyTable) -> float:
    """AIHTR per step."""
    found = tm.evaluate(WALK, table)
    return float(found.aihtr / found.expected_length)


def after(table: PolicyTable, each: int = 1000, discount: float = 0.95) -> PolicyTable:
    return PolicyTable(WALK, tried(WALK, table.sets, Draws(WALK, each), discount))


def test_sets_that_have_to_change_together_do() -> None:
    """Ascent ends .05 per step below the optimum."""
    stuck, best = searched(WALK), worth(tm.solve(WALK).table)
    assert worth(stuck) < best - 0.04
    assert best - 0.02 < worth(after(stuck)) <= best + 1e-12


def test_the_optimum_stays_where_few_paths_judge() -> None:
    best = tm.solve(WALK).table
    assert (after(best, each=20).sets != best.sets).nnz == 0


def test_paths_may_all_end_before_the_last_step() -> None:
    """The target leaves from the last cell at once: no path that begins there is left to be missed."""
    kernel = WALK.kernel.toarray()
    kernel[-1] = 0.0
    world = tm.World(kernel, 4, cost=0.4, t_max=WALK.t_max)
    best = tm.solve(world).table
    assert (tried(world, best.sets, Draws(world, 200), 0.95) != best.sets).nnz == 0


def test_no_proposal_is_taken_that_other_paths_do_not_confirm() -> None:
    """Sets that fit one path from each cell are poor on others."""
    best, few, many, drawn = tm.solve(WALK).table, Draws(WALK, 1), Draws(WALK, 200), 0

    def draw() -> np.ndarray:
        nonlocal drawn
        drawn += 1
        return few() if drawn <= joint_trials._JUDGES else many()  # those that propose come first

    assert worth(PolicyTable(WALK, tried(WALK, best.sets, draw, 0.95))) > worth(best) - 1e-3
