"""What of the paper's theorems is left where targets have a mode beside their cell."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from trackmdp.paper.theorems import Check
from trackmdp.solvers import qmdp
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.keyed import averaged
from trackmdp.solvers.keyed_search import cell_bound
from trackmdp.solvers.solution import Solution
from trackmdp.world.modes import HiddenWorld

_OF_CELLS = {
    "Theorem 1": "p_j > c/r is sensed, p_j the probability of cell j given the last located cell",
    "Lemma 1": "known at b but undetected is worth at most located at b",
    "Theorem 2": "V*_TMDP = V*_POMDP, the state being the last located cell, the clock and the sets since",
    "Theorem 3": "the estimate from Q is the belief",
    "Q_MDP": "the threshold on p_j is Q_MDP's action, and V*_QMDP as printed solves its equation",
}
"""Statements whose state is the last located cell: of a target with a mode it says too little of the next move."""


def check_modes(world: HiddenWorld, solution: Solution, tolerance: float) -> Iterator[Check]:
    """The statements that have no case here, and the order of values, which holds all the same.

    Args:
        world: the problem.
        solution: the best policy that was found, as good as what it remembers.
        tolerance: deviation, relative to the largest value, that counts as equal.
    """
    for name, statement in _OF_CELLS.items():
        note = "the next move depends on a mode as well: the last cell is no state"
        yield Check(name, statement, -np.inf, holds=True, note=note)
    scale = tolerance * max(1.0, float(np.abs(solution.bound).max()))
    plain, bound = evaluate(world, qmdp.solve(averaged(world))), cell_bound(world)
    note = f"found {solution.lower:.6f}, bound {bound.mean():.6f}"
    above = float((solution.value - bound).max())
    statement = "what was found <= clocked bound, which knows the mode"
    yield Check("order", statement, above, holds=above <= scale, note=note)
    # Shown, not claimed: nothing says that what was found is the best that its memory allows.
    above = plain.aihtr - solution.lower
    statement = "Q_MDP for the moves of cells, modes averaged <= what was found"
    yield Check("order", statement, above, holds=above <= scale, expected=False, note=f"Q_MDP {plain.aihtr:.6f}")
