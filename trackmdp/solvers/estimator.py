"""Theorem 3: the position of a target that was missed, estimated from Q-values alone.

Let ã be all sensors on, and ã_x all but the one at x. Then Q(s, ã) - Q(s, ã_x) = p(x) (r + V(x) - W(x)) - c_x p_in:
a miss under ã_x reveals the position x, but the clock runs on, and W(x) is the value from there. The paper (Theorem 3)
sets W = V, which is right about the position but not about the clock. With the true W, solving for p(x) returns the
belief's probability exactly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from trackmdp.policies.table import PolicyTable
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.known import tables, up_to
from trackmdp.solvers.layers import Layer, layer_sets, reachable_layers
from trackmdp.solvers.prediction import renewal
from trackmdp.solvers.renewal import IndexArray, accumulate, per_row
from trackmdp.solvers.search import InnerProblem
from trackmdp.world.model import Array, BoolArray, World

_MOST_NODES = 100_000
"""Choices looked at per table; where it ends early, W is an upper bound, and the exact form is exact all the same."""


@dataclass(frozen=True)
class PositionEstimate:
    """What Q says about the next position, at every info state that a policy can be in after n misses.

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
    """Share of missed steps whose position is estimated right; 1 where nothing is ever missed.

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
    layers = reachable_layers(world, world.num_choices)
    # W after n + 1 misses, best play from a known position: there are t_max - n sets left then.
    later = tables(InnerProblem.of(world, layers, value), slack=1e-9, run=up_to(_MOST_NODES))[::-1]
    mass, estimates = np.ones(world.num_cells), []
    for n, sensed in enumerate(layer_sets(layers, policy)):
        predicted = mass @ layers[n + 1].moves
        before = per_row(layers[n].rows, mass, world.num_cells)
        estimates.append(_estimate(world, n, layers[n + 1], predicted, before, value, later[n], ~sensed))
        mass = predicted * ~sensed
    return estimates


def accuracy(world: World, policy: PolicyTable, value: Array | None = None) -> EstimatorAccuracy:
    """How often the estimates are right on missed steps, pooled over a uniform start.

    Args:
        world: the problem.
        policy: the one that senses.
        value: `[M]`, V of the Q-values; the policy's own where not given.
    """
    own = evaluate(world, policy).value if value is None else value
    visits = _visits(world, policy)
    missed, right = 0.0, np.zeros(3)
    for estimate in positions(world, policy, own):
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
    world: World, n: int, layer: Layer, predicted: Array, before: Array, value: Array, later: Array, unsensed: BoolArray
) -> PositionEstimate:
    # joint probabilities become beliefs: divided by that of the misses so far
    reached = np.flatnonzero(predicted > 0)
    rows, cells = layer.rows[reached], layer.cells[reached]
    p = predicted[reached] / before[rows]
    inside = per_row(rows, p, world.num_cells)[rows]
    # Q(s, ã) and Q(s, ã_x) share all terms but those of x.
    all_on = p * (world.reward + value[cells]) - world.cost[cells] * inside
    difference = all_on - p * later[cells]
    paper = (difference + world.cost[cells]) / world.reward
    # Where being detected is worth nothing, Q says nothing about x, and the estimate is 0.
    worth = world.reward + value[cells] - later[cells]
    exact = np.divide(difference + world.cost[cells] * inside, worth, out=np.zeros_like(p), where=worth != 0.0)
    return PositionEstimate(n, rows, cells, p, paper, exact, predicted[reached] * unsensed[reached])


def _best(rows: IndexArray, score: Array, allowed: BoolArray) -> IndexArray:
    """The allowed entry of highest score in each row; of scores equal but for rounding, the first."""
    entries = np.flatnonzero(allowed)
    # rounding decides no tie: scores equal to nine digits are equal
    rounded = score[entries].round(9)
    order = entries[np.lexsort((entries, -rounded, rows[entries]))]
    return order[np.unique(rows[order], return_index=True)[1]]


def _visits(world: World, policy: PolicyTable) -> Array:
    """`[M]` expected renewals that start in each cell, per episode from a uniform start: s (I - T)^-1."""
    # T, the sum over the steps of a renewal; visits w solve w = s + w T, that is (I - T^T) w = s.
    hits = [hit for hit, _ in renewal(world, policy)]
    located = sum(hits, sparse.csr_array(hits[0].shape))
    start = np.zeros(located.shape[0])
    start[: world.num_cells] = 1.0 / world.num_cells
    return accumulate(sparse.csr_array(located.T), start, world.size)[: world.num_cells]
