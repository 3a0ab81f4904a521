"""Theorem 3: the position of a target that was missed, estimated from Q-values alone.

Let ã be all sensors on, and ã_x all but the one at x. Then Q(s, ã) - Q(s, ã_x) = p(x) (r + V(x) - W(x)) - c_x p_in:
a miss under ã_x reveals the position x, but the clock runs on, and W(x) is the value from there. The paper (Theorem 3)
sets W = V, which is right about the position but not about the clock. With the true W, solving for p(x) returns the
belief's probability exactly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trackmdp.arrays.entries import per_row
from trackmdp.arrays.types import Array, BoolArray, IndexArray
from trackmdp.policies.table import PolicyTable
from trackmdp.solvers.certify.inner import InnerProblem
from trackmdp.solvers.certify.known import tables, up_to
from trackmdp.solvers.renewal import Renewal
from trackmdp.solvers.value import key_visits
from trackmdp.solvers.walk import Step
from trackmdp.world.model import World

_MOST_NODES = 100_000
"""Choices looked at per table; where it ends early, W is an upper bound, and the exact form is exact all the same."""


@dataclass(frozen=True)
class PositionEstimate:
    """Estimates of the next position by Q, at every info state that a policy can be in after n misses.

    Attributes:
        n: misses so far.
        rows, cells: `[E]`, located cell and possible next position.
        belief: `[E]`, Pr(X_{k+1} = cell | s_k), from the belief filter.
        paper: `[E]`, (Q(s, ã) - Q(s, ã_x) + c_x) / r, as printed.
        exact: `[E]`, (Q(s, ã) - Q(s, ã_x) + c_x p_in) / (r + V(x) - W(x)).
        missed: `[E]`, joint probability, per renewal, of n misses, this position next, and missing it as well.
    """

    n: int
    rows: IndexArray
    cells: IndexArray
    belief: Array
    paper: Array
    exact: Array
    missed: Array


@dataclass(frozen=True)
class EstimatorAccuracy:
    """Share of missed steps with a correct estimate of the position; 1 where nothing is ever missed.

    Attributes:
        paper: argmax of the paper's form.
        exact: argmax of the exact form.
        bayes: argmax of the belief; nothing is better.
        missed_per_episode: steps in the grid without detection, per episode.
    """

    paper: float
    exact: float
    bayes: float
    missed_per_episode: float


def positions(world: World, policy: PolicyTable, value: Array) -> list[PositionEstimate]:
    """The estimates at every info state that `policy` brings about, n = 0 ... t_max.

    Q-values are those of playing best from a known position, V = `value` once located: the optimal policy's own
    where `policy` and `value` are optimal.
    """
    renewal = Renewal(world, world.motion)
    # W after n + 1 misses, best play from a known position: there are t_max - n sets left then.
    later = tables(InnerProblem.of(renewal, value), slack=1e-9, run=up_to(_MOST_NODES))[::-1]
    mass, estimates = np.ones(world.num_cells), []
    for n, (step, sensed) in enumerate(zip(renewal.free, renewal.sets(policy), strict=True)):
        predicted = mass @ step.moves
        before = per_row(step.before, mass, world.num_cells)
        left = ~sensed[:, 0]
        estimates.append(_estimate(world, step, predicted, before, value, later[n], left))
        mass = predicted * left
    return estimates


def accuracy(world: World, policy: PolicyTable, value: Array) -> EstimatorAccuracy:
    """How often the estimates are right on missed steps, pooled over a uniform start.

    Args:
        world: the problem.
        policy: the one that senses.
        value: `[M]`, V of the Q-values.
    """
    visits = key_visits(world, policy)
    missed, right = 0.0, np.zeros(3)
    for estimate in positions(world, policy, value):
        # Expected number of such misses per episode: renewals in the row's cell, times the joint probability within
        # one.
        weight = visits[estimate.rows] * estimate.missed
        missed += float(weight.sum())
        for which, score in enumerate((estimate.paper, estimate.exact, estimate.belief)):
            right[which] += float(weight[_best(estimate.rows, score, estimate.missed > 0)].sum())
    # Rounding may leave a share of 1 + 1e-16.
    paper, exact, bayes = np.minimum(right / missed, 1.0) if missed else np.ones(3)
    return EstimatorAccuracy(float(paper), float(exact), float(bayes), missed)


def _estimate(
    world: World,
    step: Step,
    predicted: Array,
    before: Array,
    value: Array,
    later: Array,
    unsensed: BoolArray,
) -> PositionEstimate:
    # joint probabilities become beliefs: divided by the probability of the misses so far
    reached = np.flatnonzero(predicted > 0)
    rows, cells = step.rows[reached], step.states[reached]
    p = predicted[reached] / before[rows]
    inside = per_row(rows, p, world.num_cells)[rows]
    # Q(s, ã) and Q(s, ã_x) share all terms but those of x.
    all_on = p * (world.reward + value[cells]) - world.cost[cells] * inside
    difference = all_on - p * later[cells]
    paper = (difference + world.cost[cells]) / world.reward
    # Where a detection is worth nothing, Q contains nothing about x, and the estimate is 0.
    worth = world.reward + value[cells] - later[cells]
    exact = np.divide(
        difference + world.cost[cells] * inside, worth, out=np.zeros_like(p), where=worth != 0.0
    )
    return PositionEstimate(
        step.n, rows, cells, p, paper, exact, predicted[reached] * unsensed[reached]
    )


def _best(rows: IndexArray, score: Array, allowed: BoolArray) -> IndexArray:
    """The allowed entry of highest score in each row; of scores equal but for rounding, the first."""
    entries = np.flatnonzero(allowed)
    # rounding decides no tie: scores equal to nine digits are equal
    rounded = score[entries].round(9)
    order = entries[np.lexsort((entries, -rounded, rows[entries]))]
    return order[np.unique(rows[order], return_index=True)[1]]
