"""Policies that decide from the prediction: where the target may be next, given where it was located and the misses."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import sparse

from trackmdp.policies.table import PolicyTable
from trackmdp.solvers.cover import Offer, best_sets
from trackmdp.solvers.layers import within_window
from trackmdp.solvers.renewal import IndexArray, per_row, row_index
from trackmdp.world.model import Array, World


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

    def part(self, share: npt.NDArray[np.floating[Any]]) -> sparse.csr_array:
        """`[M, M]` sparse, `share` `[E]` times the mass of each entry; entries without mass are dropped."""
        mass, count = self.mass * share, len(self.before)
        # entries are in order of their rows, so that counting those kept gives the row pointer
        kept = mass > 0
        pointer = np.zeros(count + 1, dtype=self.cells.dtype)  # int32 where that is enough: SciPy takes the widest
        np.cumsum(np.bincount(self.rows[kept], minlength=count), out=pointer[1:])
        return sparse.csr_array((mass[kept], self.cells[kept], pointer), shape=(count, count))


def predict(world: World, undetected: sparse.csr_array, n: int) -> Prediction:
    """The prediction from `[M, M]` undetected mass after n misses, row x being that of plans made in x."""
    # the sum over a row of `undetected` is the probability of the misses: mass is joint, not conditioned on them
    moved = sparse.csr_array(undetected @ world.kernel)
    moved.sort_indices()
    rows, before = row_index(moved), per_row(row_index(undetected), undetected.data, world.num_cells)
    return Prediction(n, rows, moved.indices, moved.data, before, per_row(rows, moved.data, world.num_cells))


def unroll(world: World, rule: Callable[[Prediction], Offer], *, learns: bool = True) -> PolicyTable:
    """The policy that takes the set of most worth by a `rule` from a prediction, within the task's window.

    Cells of probability zero are never sensed, and after a miss that cannot happen nothing is.
    """
    undetected, sensed = sparse.eye_array(world.num_cells, format="csr"), []
    for n in range(world.num_choices):
        seen = predict(world, undetected, n)
        on = best_sets(world, seen.rows, seen.cells, rule(seen), within_window(world, seen.rows, seen.cells))
        sensed.append((on.rows, on.sensors))
        undetected = seen.part(1.0 - on.seen * world.detects(seen.cells) * learns)
    return PolicyTable.from_sensed(world, sensed)


def followed(world: World, policy: PolicyTable) -> Iterator[Prediction]:
    """The predictions after 0 ... t_max misses along the plans of a policy."""
    undetected = sparse.eye_array(world.num_cells, format="csr")
    for n in range(world.num_choices):
        seen = predict(world, undetected, n)
        yield seen
        undetected = seen.part(1.0 - policy.on(n, seen.rows, seen.cells) * world.detects(seen.cells))


def renewal(world: World, policy: PolicyTable) -> Iterator[tuple[sparse.csr_array, Array]]:
    """What happens at each step from one detection to the next, for all located cells at once.

    A safe action that may miss is repeated until it locates, so that there is no last step. Then there are S = 2M
    states: M + j stands for the target in j, missed there by the safe action, and is left after one step, the next safe
    action. Otherwise S = M.

    Yields:
        t_max + 2 pairs, the last of the forced step: `[S, S]` sparse, the probability of being located in j at this
        step (column M + j: of being missed in j by the safe action), and `[S, 6]`, expected reward, step in the grid,
        detection, sensors on by choice, safe action, step.
    """
    # What the M states of a missed target do: all of it at the first step, nothing at the later ones.
    nowhere = sparse.csr_array((world.num_cells, world.num_cells))
    nothing = nowhere, nowhere, np.zeros((world.num_cells, 6))
    last, start = world.num_choices, sparse.eye_array(world.num_cells, format="csr")
    again = nothing if world.safe else _safe_action(world, predict(world, start, last))
    undetected = start
    for n in range(last + 1):
        seen = predict(world, undetected, n)
        hit, undetected, earned = _free_choice(world, policy, seen) if n < last else _safe_action(world, seen)
        if world.safe:
            yield hit, earned
            continue
        found, missed, after = again
        yield _blocks(hit, undetected if n == last else nowhere, found, missed), np.concatenate([earned, after])
        again = nothing


def _free_choice(
    world: World, policy: PolicyTable, seen: Prediction
) -> tuple[sparse.csr_array, sparse.csr_array, Array]:
    """A step with the sets of `policy`: `[M, M]` where they locate the target, where they miss it, six figures."""
    m, nothing = world.num_cells, np.zeros(world.num_cells)
    report = policy.on(seen.n, seen.rows, seen.cells) * world.detects(seen.cells)
    detected = per_row(seen.rows, seen.mass * report, m)
    # sensors are paid while the target is in the grid, whether or not it is where they look
    reward = world.reward * detected - policy.spent(seen.n, world.cost) * seen.inside
    sensors = policy.spent(seen.n, np.ones(world.total_sensors)) * seen.inside
    figures = np.stack([reward, seen.inside, detected, sensors, nothing, seen.before], axis=1)
    return seen.part(report), seen.part(1.0 - report), figures


def _safe_action(world: World, seen: Prediction) -> tuple[sparse.csr_array, sparse.csr_array, Array]:
    """The forced step: `[M, M]` where it locates the target, where it misses it, and six figures."""
    share, nothing = world.safe_detection[seen.cells], np.zeros(world.num_cells)
    detected = per_row(seen.rows, seen.mass * share, world.num_cells)
    reward = (world.reward - world.safe_cost) * seen.inside - world.reward * (seen.inside - detected)
    figures = np.stack([reward, seen.inside, detected, nothing, seen.inside, seen.before], axis=1)
    return seen.part(share), seen.part(1.0 - share), figures


def _blocks(*parts: sparse.csr_array) -> sparse.csr_array:
    """`[2M, 2M]` of four `[M, M]`, row by row."""
    a, b, c, d = parts
    return sparse.csr_array(sparse.block_array([[a, b], [c, d]], format="csr"))
