"""Receding horizon: choose `depth` sets jointly with a simpler value after them, apply the first, plan again."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, TypeAlias

import numpy as np
from scipy import sparse

from trackmdp.errors import UserError
from trackmdp.policies.table import PolicyTable
from trackmdp.solvers.bounds import clocked_table, valid
from trackmdp.solvers.branch import Tree
from trackmdp.solvers.exchange import exchange
from trackmdp.solvers.known import first_guess, tables, up_to
from trackmdp.solvers.layers import Layer, policy_table, reachable_layers
from trackmdp.solvers.regions import adopted
from trackmdp.solvers.search import InnerProblem
from trackmdp.world.model import Array, BoolArray, World

Tail: TypeAlias = Literal["qmdp", "clocked"]

_SLACK = 1e-9
_MOST_NODES = 2_000_000
"""Choices looked at per plan; a count, not a time, so that the same world gives the same policy."""


def solve(world: World, *, depth: int = 2, tail: Tail = "clocked") -> PolicyTable:
    """The policy that plans `depth` sets at every info state, fewer where the safe action comes before.

    Args:
        world: the problem.
        depth: sets planned, at least 1; 1 gives Q_MDP (with the in-grid factor) and the clocked policy.
        tail: the value after them: `qmdp`, the position known after every action, or `clocked`, U(j, n).
    """
    if world.coverage is not None:
        raise UserError("solver=lookahead: plans for sensors that each cover one cell; expected clocked or optimal")
    # [M, t_max + 2], worth of the target being known in a cell after n misses
    tails = np.repeat(valid(world)[:, None], world.t_max + 2, axis=1) if tail == "qmdp" else clocked_table(world).table
    layers = reachable_layers(world, world.num_choices)
    sets: list[BoolArray] = []
    mass = np.ones(world.num_cells)
    for n in range(world.num_choices):
        # the safe action ends every plan: n + ahead is at most t_max + 1
        ahead = min(depth, world.num_choices - n)
        # tails[:, n + ahead]: after `ahead` misses more the clock reads n + ahead, and the tail's value is that of this
        # column.
        problem = InnerProblem(world, layers[n : n + ahead + 1], world.reward + tails[:, 0], tails[:, n + ahead])
        sets.append(_first_set(problem, layers, mass))
        mass = (mass @ layers[n + 1].moves) * (1.0 - sets[-1] * world.detects(layers[n + 1].cells))
    return policy_table(world, layers, sets)


def _first_set(problem: InnerProblem, layers: list[Layer], mass: Array) -> BoolArray:
    """`[E]` the first set of the best plan from each located cell, on the second layer of `problem`."""
    # R of a known position is that of the first layers, which begin in each cell.
    world, run, start = problem.world, up_to(_MOST_NODES), replace(problem, layers=layers[: problem.length + 1])
    known = tables(start, slack=_SLACK, run=run)
    sets = exchange(problem, first_guess(problem, known, mass), mass)
    origin = problem.layers[0]
    # one problem per located cell: its undetected mass after the sets carried out so far
    here = sparse.csr_array((mass, (origin.rows, origin.cells)), shape=(world.num_cells, world.num_cells))
    here.eliminate_zeros()
    tree = Tree(problem, known, problem.worth(sets, mass), _SLACK, here)
    run(tree)
    return (adopted(problem, sets, tree, mass) or sets)[0]
