"""R_h(j) = F_h(e_j): the largest expected reward of h more sets when the target is known to be in j and n runs on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy import sparse

from trackmdp.arrays.types import Array, BoolArray
from trackmdp.solvers.certify.branch import Tree
from trackmdp.solvers.certify.delayed import Delayed
from trackmdp.solvers.certify.inner import InnerProblem
from trackmdp.solvers.plans import Plans


def first_guess(
    problem: InnerProblem, known: list[Array], mass: Array | None = None
) -> tuple[Plans, list[BoolArray]]:
    """Plans, and sets found by a homotopy from the credit r + V - R, `known` being R_0 ... R_{H-1}; see `search`."""
    # With H sets, after set t there are H - 1 - t left: credit_t(j) = r + V(j) - R_{H-1-t}(j).
    credit = [problem.detected - known[problem.length - 1 - t] for t in range(problem.length)]
    plans = problem.plans(mass, credit)
    sets = plans.none()
    for optimism in np.linspace(1.0, 0.0, 11):
        sets = plans.ascend(sets, sweeps=3, optimism=float(optimism))
    return plans, sets


def tables(
    problem: InnerProblem,
    *,
    slack: float,
    run: Callable[[Tree], None],
    known: list[Array] | None = None,
) -> list[Array]:
    """R_0 ... R_{H-1} of a `problem` of length H, each `[M]`; upper bounds where `run` ends a search early.

    Args:
        problem: its window is left out of account: the position j is revealed in the middle of a plan made in any x,
            and a window around x does not limit j. R is then a bound for every x, and exact without a window.
        slack: worth that may be missed.
        run: runs the tree of one table, to its end or not.
        known: R_0, R_1, ..., as far as they are known already.
    """
    known = [problem.missed] if known is None else known[: problem.length]
    for sets in range(len(known), problem.length):
        # R_h needs the first h steps only.
        part = replace(problem, first=0, length=sets, windowed=False)
        plans, found = first_guess(part, known)
        tree = Tree(part, known, plans.worth_of(found), slack)
        run(tree)
        known.append(tree.upper())
    return known


def planted(
    problem: InnerProblem,
    lower: Array,
    slack: float,
    run: Callable[[Tree], None],
    mass: sparse.csr_array | None = None,
) -> Tree:
    """The tree of a `problem`, not searched yet, with the tightest tables there are; `run` makes them, see `Tree`."""
    delayed = Delayed.of(problem.world, problem.detected, problem.missed, problem.length)
    revealed = None if delayed is None else delayed.revealed
    known = tables(problem, slack=slack, run=run, known=revealed)
    return Tree(problem, known, lower, slack, mass, delayed)


def adopted(
    problem: InnerProblem, sets: list[BoolArray], tree: Tree, mass: Array | None = None
) -> list[BoolArray] | None:
    """`sets` `[G, 1]` with the better plans that a tree has found, from `mass` `[E]`; None if there are none.

    Without a `mass` it is 1 in each located cell.
    """
    better, left = tree.improvements()
    if not better.any():
        return None
    found, mass = [], np.ones(problem.world.num_cells) if mass is None else mass
    for turn, on, out in zip(problem.turns, sets, left, strict=True):
        mass = mass @ turn.moves
        # A plan of the tree senses every possible cell but those left out.
        rows, cells = turn.choice.rows, turn.choice.sensors
        sensed = (mass > 0) & ~out.has(rows, cells)
        found.append(np.where(better[rows, None], sensed[:, None], on))
        mass = mass * (1.0 - turn.choice.report(found[-1])[:, 0])
    return found


def up_to(nodes: int) -> Callable[[Tree], None]:
    """Runs a tree until so many choices of it have been looked at."""
    return lambda tree: tree.run(lambda tree: tree.nodes < nodes)
