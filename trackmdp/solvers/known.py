"""R_h(j) = F_h(e_j): the largest expected reward of h more sets when the target is known to be in j and n runs on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from trackmdp.solvers.branch import Tree
from trackmdp.solvers.layers import Layer, reachable_layers
from trackmdp.solvers.search import InnerProblem
from trackmdp.world.model import Array, BoolArray, World


def first_guess(problem: InnerProblem, known: list[Array], mass: Array) -> list[BoolArray]:
    """Sets found by a homotopy from the credit r + V - R, `known` being R_0 ... R_{H-1}; see `search`."""
    # with H sets, after set t there are H - 1 - t left: credit_t(j) = r + V(j) - R_{H-1-t}(j)
    credit = [problem.detected - known[problem.length - 1 - t] for t in range(problem.length)]
    sets = problem.none_sensed()
    for optimism in np.linspace(1.0, 0.0, 11):
        sets = problem.ascend(sets, mass, sweeps=3, optimism=float(optimism), credit=credit)
    return sets


def next_table(problem: InnerProblem, known: list[Array], slack: float) -> Tree:
    """The tree that gives R_H once run (`Tree.upper`), H the length of `problem`, from R_0 ... R_{H-1}.

    The position j is revealed in the middle of a plan made in any x, so that no window around j limits the sets: R is
    then an upper bound for every x, and exact without a window.
    """
    problem, mass = replace(problem, windowed=False), np.ones(problem.world.num_cells)
    lower = problem.worth(first_guess(problem, known, mass), mass)
    return Tree(problem.world, problem.detected, known, lower, slack, windowed=False)


def tables(
    world: World,
    detected: Array,
    missed: Array,
    length: int,
    *,
    slack: float,
    run: Callable[[Tree], None],
    layers: list[Layer] | None = None,
    known: list[Array] | None = None,
) -> list[Array]:
    """R_0 ... R_length, each `[M]`; upper bounds where `run` ends a search early.

    Args:
        world: the problem.
        detected: `[M]`, worth of sensing the target in each cell, r + V.
        missed: `[M]`, R_0.
        length: sets of the last table.
        slack: worth that may be missed.
        run: runs the tree of one table, to its end or not.
        layers: possible positions, where they are known already.
        known: R_0, R_1, ..., as far as they are known already.
    """
    # R_h needs h layers only, the first ones of those that are there
    layers = reachable_layers(world, length) if layers is None else layers
    known = [missed] if known is None else known[: length + 1]
    for sets in range(len(known), length + 1):
        tree = next_table(InnerProblem(world, layers[: sets + 1], detected, missed), known, slack)
        run(tree)
        known.append(tree.upper())
    return known
