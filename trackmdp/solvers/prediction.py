"""Policies that decide from the prediction: where the target may be next, given where it was located and the misses."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from trackmdp.policies.table import PolicyTable
from trackmdp.solvers.layers import sensed_csr, within_window
from trackmdp.solvers.renewal import IndexArray, per_row, row_index
from trackmdp.world.model import Array, BoolArray, World

__all__ = ["Prediction", "predict", "renewal", "unroll"]


@dataclass(frozen=True)
class Prediction:
    """Where the target may be next, for all located cells at once, after n misses; entries of positive mass only.

    Attributes:
        n: misses so far.
        rows, cells: `[E]`, located cell and possible next cell of each entry.
        mass: `[E]`, joint probability of the misses so far and the target moving to `cells`.
        before: `[M]`, probability of the n misses.
        inside: `[M]`, probability of the misses and of still being in the grid after the move.
    """

    n: int
    rows: IndexArray
    cells: IndexArray
    mass: Array
    before: Array
    inside: Array

    def part(self, share: Array | BoolArray) -> sparse.csr_array:
        """`[M, M]` sparse, `share` `[E]` times the mass of each entry; entries without mass are dropped."""
        mass, count = self.mass * share, len(self.before)
        # entries are in order of their rows, so that counting those kept gives the row pointer
        kept = mass > 0
        pointer = np.concatenate([[0], np.cumsum(np.bincount(self.rows[kept], minlength=count))])
        return sparse.csr_array((mass[kept], self.cells[kept], pointer), shape=(count, count))


def predict(world: World, undetected: sparse.csr_array, n: int) -> Prediction:
    """The prediction from `[M, M]` undetected mass after n misses, row x being that of plans made in x."""
    # the sum over a row of `undetected` is the probability of the misses: mass is joint, not conditioned on them
    moved = sparse.csr_array(undetected @ world.kernel)
    moved.sort_indices()
    rows, before = row_index(moved), per_row(row_index(undetected), undetected.data, world.num_cells)
    return Prediction(n, rows, moved.indices, moved.data, before, per_row(rows, moved.data, world.num_cells))


def unroll(world: World, rule: Callable[[Prediction], BoolArray]) -> PolicyTable:
    """The policy of a `rule` from a prediction to the entries sensed, bool `[E]`, within the task's window.

    Cells of probability zero are never sensed, and after a miss that cannot happen nothing is.
    """
    undetected, sensed = sparse.eye_array(world.num_cells, format="csr"), []
    for n in range(world.num_choices):
        seen = predict(world, undetected, n)
        on, allowed = rule(seen), within_window(world, seen.rows, seen.cells)
        on = on if allowed is None else on & allowed
        sensed.append((seen.rows[on], seen.cells[on]))
        undetected = seen.part(~on)
    return PolicyTable(world, sensed_csr(world, sensed))


def renewal(world: World, policy: PolicyTable) -> Iterator[tuple[sparse.csr_array, Array]]:
    """What happens at each step from one detection to the next, for all located cells at once.

    Yields:
        t_max + 2 pairs, the last of the forced step: `[M, M]` sparse, the probability of being located in j at this
        step, and `[M, 6]`, expected reward, step in the grid, detection, sensors on by choice, safe action, step.
    """
    m, nothing = world.num_cells, np.zeros(world.num_cells)
    undetected = sparse.eye_array(m, format="csr")
    for n in range(world.num_choices):
        seen = predict(world, undetected, n)
        on = policy.on(n, seen.rows, seen.cells)
        # sensors are paid while the target is in the grid, whether or not it is where they look
        hit, undetected = seen.part(on), seen.part(1.0 - on)
        detected = per_row(seen.rows, seen.mass * on, m)
        reward = world.reward * detected - policy.spent(n, world.cost) * seen.inside
        sensors = policy.spent(n, np.ones(m)) * seen.inside
        yield hit, np.stack([reward, seen.inside, detected, sensors, nothing, seen.before], axis=1)
    forced = predict(world, undetected, world.num_choices)
    reward = (world.reward - world.safe_cost) * forced.inside
    found = forced.part(np.ones(len(forced.mass)))
    yield found, np.stack([reward, forced.inside, forced.inside, nothing, forced.inside, forced.before], axis=1)
