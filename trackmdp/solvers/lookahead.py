"""Receding horizon: choose `depth` sets jointly with a simpler value after them, apply the first, plan again."""

from __future__ import annotations

from typing import Literal, TypeAlias

import numpy as np
from scipy import sparse

from trackmdp.arrays.types import Array, BoolArray, IndexArray
from trackmdp.policies.table import PolicyTable
from trackmdp.solvers.bounds import clocked_table, valid
from trackmdp.solvers.certify.branch import Tree
from trackmdp.solvers.certify.inner import InnerProblem
from trackmdp.solvers.certify.known import adopted, first_guess, tables, up_to
from trackmdp.solvers.exchange import exchange
from trackmdp.solvers.optimal import has_trees
from trackmdp.solvers.renewal import Renewal
from trackmdp.world.model import World

Tail: TypeAlias = Literal["qmdp", "clocked"]

_SLACK = 1e-9
"""Worth of a plan that may be missed, in rewards."""
_MOST_NODES = 2_000_000
"""Choices looked at per plan; a count, not a time, so that the same world gives the same policy."""


def solve(world: World, *, depth: int = 2, tail: Tail = "clocked") -> PolicyTable:
    """The policy that plans `depth` sets at every info state, fewer where the safe action comes before.

    The plans are the best ones; those of sensors that share cells or a budget are as good as exchange finds.

    Args:
        world: the problem.
        depth: sets planned, at least 1; 1 gives Q_MDP (with the in-grid factor) and the clocked policy.
        tail: the value after them: `qmdp`, the position known after every action, or `clocked`, U(j, n).
    """
    world = World.of(world.remembering(), world.kernel)
    # [M, t_max + 2], worth of the target being known in a cell after n misses
    tails = (
        np.repeat(valid(world)[:, None], world.t_max + 2, axis=1)
        if tail == "qmdp"
        else clocked_table(world).table
    )
    renewal = Renewal(world, world.motion)
    sets: list[BoolArray] = []
    mass = np.ones(world.num_cells)
    states: IndexArray = np.arange(world.num_cells)
    for n in range(world.num_choices):
        # the safe action ends every plan: n + ahead is at most t_max + 1
        ahead = min(depth, world.num_choices - n)
        # tails[:, n + ahead]: after `ahead` misses more the clock reads n + ahead, the column of the tail's value.
        detected, missed = world.reward + tails[:, 0], tails[:, n + ahead]
        problem = InnerProblem(renewal, detected, missed, ahead, first=n)
        sets.append(_first_set(problem, mass, states))
        report = renewal.choices[n].report(sets[-1])[:, 0]
        mass, states = (mass @ renewal.free[n].moves) * (1.0 - report), renewal.free[n].states
    return renewal.table(sets)


def _first_set(problem: InnerProblem, mass: Array, states: IndexArray) -> BoolArray:
    """`[G, 1]` the first set of the best plan from each located cell; `mass` `[E]` is undetected in `states` `[E]`."""
    world, run = problem.world, up_to(_MOST_NODES)
    cellwise, slack = has_trees(world), _SLACK * world.reward
    # Without trees optimism is that of a search that is left after one more miss.
    known = tables(problem, slack=slack, run=run) if cellwise else [problem.missed] * problem.length
    plans, sets = first_guess(problem, known, mass)
    sets = exchange(plans, sets, np.ones(world.num_cells, bool))
    if not cellwise:
        return sets[0]
    # One problem per located cell: its undetected mass after the sets carried out so far.
    place = problem.turns[0].before, states
    here = sparse.csr_array((mass, place), shape=(world.num_cells, world.num_cells))
    here.eliminate_zeros()
    tree = Tree(problem, known, plans.worth_of(sets), slack, here)
    run(tree)
    return (adopted(problem, sets, tree, mass) or sets)[0]
