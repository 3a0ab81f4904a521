"""Totals that the motion alone decides, whatever is sensed: expected steps, and worth at the safe action."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy import sparse

from trackmdp.arrays.types import Array
from trackmdp.errors import UserError
from trackmdp.solvers.factors import ENDLESS
from trackmdp.solvers.linear import RenewalSystem, accumulate
from trackmdp.world.model import World

# Changes that count as rounding, relative to the largest number.
_LAST_BITS = 4.0 * float(np.finfo(np.float64).eps)
# Where some cells have no way out, I - P is singular; if rounding lets the solve pass, lengths come out negative or
# about 1 / 1e-16. No kernel that is meant to end comes near 1e12 steps.
_LONGEST_EPISODE = 1e12


def forced_worth(world: World, detected: Array) -> Array:
    """`[Z]` worth of the target in each state when the safe action is next, repeated until it locates the target.

    L = P [p_s (r + V) + (1 - p_s) L] - D p_in, `detected` `[Z]` being r + V: another linear system, of matrix
    P (1 - p_s), which without misses is empty.
    """
    if world.safe:
        return world.kernel @ (detected - world.safe_cost)
    found = world.safe_detection[world.motion.cell]
    located = world.kernel @ (found * detected) - world.safe_cost * world.stay_probability
    return _safe_system(world).solve(located)


@lru_cache(maxsize=1)
def _safe_system(world: World) -> RenewalSystem:
    """The moves on which the safe action misses the target."""
    missed = world.kernel.multiply(1.0 - world.safe_detection[world.motion.cell])
    return RenewalSystem(sparse.csr_array(missed), grid_of(world))


def grid_of(world: World) -> tuple[int, int] | None:
    """(rows, columns) where the states of a world are its cells; else None."""
    return world.size if world.modes == 1 else None


@lru_cache(maxsize=1)
def expected_steps(world: World) -> Array:
    """`[Z]` expected steps until the exit, the exit step included; sensing never changes it.

    Raises:
        UserError: from some cell the target never exits.
    """
    # L = 1 + P L: every step counts once under every policy, so P takes the place of T.
    steps = accumulate(world.kernel, np.ones(world.num_states), grid_of(world))
    check_length(steps)
    return steps


def still_to_come(world: World, change: float, largest: float, left: int) -> float | None:
    """The most that `left` further rounds add to a recursion over the steps left; None while they matter.

    A round adds no more than the largest of the last changes, `change`, times the probability that the target is still
    in the grid. It counts as rounding, which need not settle to the last bit, below a few units in the last place of
    the `largest` number.
    """
    if change == 0.0:
        return 0.0
    if change > _LAST_BITS * largest:
        return None
    try:
        return change * min(float(left), float(expected_steps(world).max()))
    except UserError:  # the target never exits
        return change * left


def summed_over(moves: sparse.csr_array, gathered: Array, steps: int) -> Array:
    """`[B]` or `[B, K]`, the sum of (moves)^t gathered over t = 0 ... steps - 1: the total of so many steps.

    Rounds that add no more than rounding are left out; see `still_to_come`.
    """
    found = np.zeros_like(gathered)
    for _ in range(steps):
        before, found = found, gathered + moves @ found
        if np.abs(found - before).max() <= _LAST_BITS * np.abs(found).max():
            break
    return found


def check_length(steps: Array) -> None:
    """Refuse expected steps that no kernel with an exit from each cell can have."""
    if (steps < 0).any() or (steps > _LONGEST_EPISODE).any():
        raise UserError(ENDLESS)
