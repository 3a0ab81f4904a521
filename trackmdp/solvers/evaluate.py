"""The exact value of a policy, from its plans: one renewal each, then one linear system over the located cells.

After a miss the next state is known in advance, so a policy is, for each located cell x, the plan of sets it senses at
n = 0 ... t_max misses. Pushing the undetected mass along the plans gives, for each x, what is earned until the next
detection, b(x), and where that will be, T(x, ·); then V = (I - T)^-1 b.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy import sparse

from trackmdp.policies.table import PolicyTable
from trackmdp.solvers.evaluation import Evaluation, pooled
from trackmdp.solvers.horizon import truncated_value
from trackmdp.solvers.prediction import renewal
from trackmdp.solvers.recorded import evaluate_recorded
from trackmdp.solvers.renewal import RenewalSystem, check_length
from trackmdp.world.model import Array, BoolArray, World
from trackmdp.world.tracks import Problem

if TYPE_CHECKING:  # torch is loaded where something that acts is asked for its sets
    from trackmdp.policies.policy import PolicyLike

__all__ = ["evaluate"]


def evaluate(problem: Problem, policy: PolicyLike | Array | BoolArray) -> Evaluation:
    """What `policy` earns: exactly on a `World`, as replayed on the held-out tracks of a `Recorded`.

    Args:
        problem: a `World`, whose episodes end by the target's exit or after `max_steps`; or `Recorded` tracks.
        policy: a `Policy` or its table, or the same dense, `[M, t_max + 1, M]`; a TensorDict module or a function
            that does not draw (`Policy.from_function`).

    Raises:
        UserError: the policy draws at random and is not one whose probabilities are known, or is for another grid.
    """
    table = _table(problem, policy)
    if not isinstance(problem, World):
        return evaluate_recorded(problem, table)
    if problem.max_steps is not None:
        return truncated_value(problem, table, problem.max_steps)
    return _whole_episodes(problem, table)


def _whole_episodes(world: World, policy: PolicyTable) -> Evaluation:
    m = world.num_cells
    states = m if world.safe else 2 * m  # see `renewal`
    located, gathered = sparse.csr_array((states, states)), np.zeros((states, 6))
    for hit, earned in renewal(world, policy):
        located, gathered = located + hit, gathered + earned
    system = RenewalSystem(located, world.size)
    # All six totals by one factorisation: reward, steps in the grid, detections, sensors, safe actions, steps [M, 6].
    totals = system.solve(gathered)
    check_length(totals[:, 5])
    error = 0.0
    if not system.exact:
        # |V - V̂| <= max (I - T)^-1 1 · max |residual|, and an episode has no more renewals than steps: those of the
        # sixth column, itself off by at most the same factor times its own residual (theory-extensions: section 0).
        residual = np.abs(system.residual(gathered, totals)).max(axis=0)
        longest = float(totals[:, 5].max()) / (1.0 - float(residual[5]))
        error = longest * float(residual[0])
    return pooled(totals[:m, :5], totals[:m, 5], error)


def _table(problem: Problem, policy: PolicyLike | Array | BoolArray) -> PolicyTable:
    """The table of a policy in any accepted form; torch is loaded only for modules and functions."""
    if isinstance(policy, PolicyTable):
        policy.check_fits(problem)
        return policy
    if isinstance(policy, np.ndarray):
        return PolicyTable.from_dense(problem, policy)
    from trackmdp.policies.policy import as_policy

    return as_policy(problem, policy)
