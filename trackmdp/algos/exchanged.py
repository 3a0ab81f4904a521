"""The last step of hindsight: exchange on the moves that were sensed, counted.

The counts are the exact expectation of the paths that hindsight puts together from sensed moves, so that what is chosen
on them uses nothing more than the paths do. They are corrected by what all of them together say (`shrinkage`).
"""

from __future__ import annotations

import numpy as np
from scipy import sparse
from torch import Tensor

from trackmdp.policies.table import PolicyTable
from trackmdp.solvers import exchange
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.kernel_estimate import KernelEstimate
from trackmdp.solvers.keyed_search import solve_keys
from trackmdp.solvers.renewal import IndexArray
from trackmdp.solvers.shrinkage import believed_world, least_worth_planning
from trackmdp.world.model import Task
from trackmdp.world.modes import HiddenWorld, Modelled

EXIT_WEIGHT = 1.0
"""The exit probability of all cells counts as one move in each, so that no episode is endless on the counts."""
MOST_MOVES = 20_000_000
"""Moves of all plans together (some 40 bytes each) up to which sets are exchanged."""


def counted_world(
    task: Task, start: Tensor, end: Tensor, *, classes: IndexArray | None = None, count: Tensor | None = None
) -> Modelled:
    """The task with the motion that was counted.

    Args:
        task: grid, rewards and costs.
        start: `[K]`, the cell before each sensed move, or the key.
        end: `[K]`, the one after it, M for outside.
        classes: `[M]`, cells of one class, away from the border, are those from which the target moves alike; None:
            judge by the counts which are, cells at the same distance from the borders together. Not read where a
            detection tells the mode.
        count: `[K]`, how many each move stands for; None: one.
    """
    # `believed` has a prior of its own in place of `weight`.
    modes, alike = task.keys.num_classes, False if task.keyed else classes is not None or None
    estimate = KernelEstimate(
        task.size, weight=1.0, exit_weight=EXIT_WEIGHT, share_cells=alike, classes=classes, modes=modes
    )
    estimate.add_moves(start.cpu().numpy(), end.cpu().numpy(), None if count is None else count.cpu().numpy())
    if not task.perfect:
        # Of the moves to a cell the share p_d is known (`report_weights`): each counts for 1 / p_d.
        counts = estimate.counts
        counts.data /= np.append(np.repeat(task.detection, modes), 1.0)[counts.indices]
    least = least_worth_planning(task)
    return believed_world(task, estimate.believed(least), least)


def exchanged_sets(world: Modelled, sets: sparse.csr_array, *, anew: bool = True) -> sparse.csr_array:
    """`[keys (t_max + 1), S]`, what exchange in the counted `world` makes of learned `sets`.

    Args:
        world: see `counted_world`.
        sets: `[keys (t_max + 1), S]`.
        anew: whether to start from `search` as well: from one start alone, regrets of .003 were left.
    """
    if _moves_of_plans(world) > MOST_MOVES:
        return sets
    learned = PolicyTable(world, sets)
    if isinstance(world, HiddenWorld):
        return solve_keys(world, start=learned).table.sets
    found = [exchange.improve(world, learned), *([exchange.solve(world)] if anew else [])]
    worth = [evaluate(world, policy).aihtr for policy in found]
    return found[int(np.argmax(worth))].sets


def _moves_of_plans(world: Modelled) -> float:
    """No fewer than the moves out of all positions that plans of t_max + 1 sets pass through."""
    states, successors = world.num_keys, int(np.diff(world.kernel.indptr).max())
    # After t moves from one cell the target is in one of at most Z^t cells, or of M.
    positions = sum(min(successors**t, states) for t in range(world.num_choices))
    return states * successors * positions
