"""The exact value of a policy, from its plans: one renewal each, then one linear system over the located cells.

After a miss the next state is known in advance, so a policy is, for each located cell x, the plan of sets it senses at
n = 0 ... t_max misses. Pushing the undetected mass along the plans gives, for each x, what is earned until the next
detection, b(x), and where that will be, T(x, ·); then V = (I - T)^-1 b.

Where episodes are truncated after `max_steps` steps, values depend on the steps left, so the linear solve becomes a
backward recursion over them. Nothing diverges where the target never exits.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy import sparse

from trackmdp.policies.table import PolicyTable
from trackmdp.solvers.alarms import believed
from trackmdp.solvers.evaluation import Evaluation, pooled
from trackmdp.solvers.keyed import evaluate_keys
from trackmdp.solvers.prediction import renewal
from trackmdp.solvers.recorded import evaluate_recorded
from trackmdp.solvers.renewal import RenewalSystem, check_length, expected_steps
from trackmdp.world.model import Array, BoolArray, World
from trackmdp.world.modes import HiddenWorld, check_revealed
from trackmdp.world.tracks import Problem

if TYPE_CHECKING:  # torch is loaded where something that acts is asked for its sets
    from trackmdp.policies.policy import PolicyLike


def truncated_value(world: World, policy: PolicyTable, max_steps: int) -> Evaluation:
    """The figures of `evaluate` for episodes of at most `max_steps` steps.

    With h steps left, V_h = Σ_t [b_t + L_t V_{h-t}] over the steps t = 1 ... min(h, t_max + 2) after a detection:
    b_t is gathered at step t, and L_t says where the target is located at step t. Kept are the last t_max + 2 V_h.
    """
    steps = list(renewal(world, policy))
    left = [np.zeros_like(steps[0][1])]  # V_{h-1}, V_{h-2}, ...
    for h in range(1, max_steps + 1):
        # zip stops at the shorter one: with h steps left only the first h steps of a renewal happen.
        now = sum(earned + hit @ later for (hit, earned), later in zip(steps[:h], left, strict=False))
        # V_h is made of the t_max + 2 before it alone: where it is the same as they are, to the last bit, so are all
        # that follow.
        if len(left) == len(steps) and all(np.array_equal(now, later) for later in left):
            break
        left = [np.asarray(now), *left[: len(steps) - 1]]
    return pooled(left[0][: world.num_cells].T)


def evaluate(
    problem: Problem,
    policy: PolicyLike | Array | BoolArray,
    *,
    guess: Array | None = None,
    false_alarm: float = 0.0,
    per_cell: bool = True,
) -> Evaluation:
    """What `policy` earns: exactly on a `World`, as replayed on the held-out tracks of a `Recorded`.

    Args:
        problem: a `World`, whose episodes end by the target's exit or after `max_steps`; or `Recorded` tracks.
        policy: a `Policy` or its table, or the same dense, `[M, t_max + 1, M]`; a TensorDict module or a function
            that does not draw (`Policy.from_function`).
        false_alarm: p_f, with which a sensor that is on reports the target in a step in which it is not there; the
            policy takes each report for the truth (`trackmdp.solvers.alarms`).
        per_cell: whether detections, sensors and safe actions are wanted of each start cell as well, which takes half
            as long again on a grid too large to factorise (a smaller one has them for nothing).
        guess: `[M]`, where the solve begins on a grid too large to factorise, such as the clocked bound.

    Raises:
        UserError: the policy draws at random and is not one whose probabilities are known, or is for another grid.
    """
    table = _table(problem, policy)
    check_revealed(problem, table.task.revealed)
    if isinstance(problem, World) and table.task.keyed and not false_alarm:
        # A policy that remembers more than it needs: the cell's one mode tells nothing.
        problem = HiddenWorld(problem.kernel, modes=1, **problem.given)
    if false_alarm:
        return believed(problem, table, false_alarm)
    if isinstance(problem, HiddenWorld):
        return evaluate_keys(problem, table)
    if not isinstance(problem, World):
        return evaluate_recorded(problem, table)
    if problem.max_steps is not None:
        return truncated_value(problem, table, problem.max_steps)
    return _whole_episodes(problem, table, guess, per_cell)


def _whole_episodes(world: World, policy: PolicyTable, guess: Array | None, per_cell: bool) -> Evaluation:
    m = world.num_cells
    states = m if world.safe else 2 * m  # see `renewal`
    located, gathered = sparse.csr_array((states, states)), np.zeros((states, 6))
    for hit, earned in renewal(world, policy):
        located, gathered = located + hit, gathered + earned
    system = RenewalSystem(located, world.size)
    if system.exact:
        # All six totals by one factorisation: reward, steps in the grid, detections, sensors, safe actions, steps.
        totals = system.solve(gathered)
        check_length(totals[:, 5])
        return pooled(totals[:m].T)
    # By iteration, the value and the pooled figures by two solves in place of six.
    length = expected_steps(world)
    # what a missed target is worth is near to what a located one in its cell is
    value = system.solve(gathered[:, 0], None if guess is None else np.tile(guess, states // m))
    # |V - V̂| <= max (I - T)^-1 1 · max |residual|, and an episode has no more renewals than steps (theory-extensions:
    # section 0); the steps are those of I - P, themselves iterated.
    error = float(length.max()) * float(np.abs(system.residual(gathered[:, 0], value)).max())
    # Sensing does not move the target, and each episode has one exit step: the steps in the grid are all but that one.
    steps = length - 1.0
    if per_cell:
        return pooled([value[:m], steps, *system.solve(gathered[:, 2:5])[:m].T, length], error)
    # Detections and the like are wanted for a uniform start s alone, s (I - T)^-1 b: with the visits v = s (I - T)^-1,
    # that is v = s + v T, each is a scalar product v b. One system goes before the next comes: both are large.
    del system
    system = RenewalSystem(sparse.csr_array(located.T), world.size)
    visits = system.solve(np.concatenate([np.full(m, 1 / m), np.zeros(states - m)]))
    return pooled([value[:m], steps, *(visits @ gathered[:, 2:5]), length], error)


def _table(problem: Problem, policy: PolicyLike | Array | BoolArray) -> PolicyTable:
    """The table of a policy in any accepted form; torch is loaded only for modules and functions."""
    if isinstance(policy, PolicyTable):
        policy.check_fits(problem)
        return policy
    if isinstance(policy, np.ndarray):
        return PolicyTable.from_dense(problem, policy)
    from trackmdp.policies.policy import as_policy

    return as_policy(problem, policy)
