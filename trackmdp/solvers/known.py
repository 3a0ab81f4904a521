"""R_h(j) = F_h(e_j): the largest expected reward of h more sets when the target is known to be in j and n runs on.

And how far trees are searched: up to so many nodes, or as the budget of a whole search allows.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy import sparse

from trackmdp.solvers.branch import Tree
from trackmdp.solvers.delayed import Delayed
from trackmdp.solvers.search import InnerProblem
from trackmdp.world.model import Array, BoolArray


def first_guess(problem: InnerProblem, known: list[Array], mass: Array) -> list[BoolArray]:
    """Sets found by a homotopy from the credit r + V - R, `known` being R_0 ... R_{H-1}; see `search`."""
    # with H sets, after set t there are H - 1 - t left: credit_t(j) = r + V(j) - R_{H-1-t}(j)
    credit = [problem.detected - known[problem.length - 1 - t] for t in range(problem.length)]
    sets = problem.none_sensed()
    for optimism in np.linspace(1.0, 0.0, 11):
        sets = problem.ascend(sets, mass, sweeps=3, optimism=float(optimism), credit=credit)
    return sets


def tables(
    problem: InnerProblem, *, slack: float, run: Callable[[Tree], None], known: list[Array] | None = None
) -> list[Array]:
    """R_0 ... R_{H-1} of a `problem` of length H, each `[M]`; upper bounds where `run` ends a search early.

    Args:
        problem: whose window is left out of account: the position j is revealed in the middle of a plan made in any x,
            and a window around x says nothing about j. R is then a bound for every x, and exact without a window.
        slack: worth that may be missed.
        run: runs the tree of one table, to its end or not.
        known: R_0, R_1, ..., as far as they are known already.
    """
    problem, mass = replace(problem, windowed=False), np.ones(problem.world.num_cells)
    known = [problem.missed] if known is None else known[: problem.length]
    for sets in range(len(known), problem.length):
        # R_h needs h layers only, the first ones of those that are there
        part = replace(problem, layers=problem.layers[: sets + 1])
        tree = Tree(part, known, part.worth(first_guess(part, known, mass), mass), slack)
        run(tree)
        known.append(tree.upper())
    return known


def planted(
    problem: InnerProblem, lower: Array, slack: float, run: Callable[[Tree], None], mass: sparse.csr_array | None = None
) -> Tree:
    """The tree of a `problem`, not searched yet, with the tightest tables there are; `run` makes them, see `Tree`."""
    delayed = Delayed.of(problem.world, problem.detected, problem.missed, problem.length)
    known = tables(problem, slack=slack, run=run, known=None if delayed is None else delayed.revealed)
    return Tree(problem, known, lower, slack, mass, delayed)


def up_to(nodes: int) -> Callable[[Tree], None]:
    """Runs a tree until so many choices of it have been looked at."""
    return lambda tree: tree.run(lambda tree: tree.nodes < nodes)


class Budget:
    """Work that may be done, in nodes, and that was; the clock is only read where a time limit is set."""

    def __init__(self, nodes: int, time_limit: float | None) -> None:
        self.nodes, self.spent, self.timed_out = nodes, 0, False
        self.started = time.monotonic()
        self._ends = None if time_limit is None else self.started + time_limit

    def left(self) -> bool:
        """Whether there is work left to do."""
        # A limit that has passed stays passed: the rounds after it end one by one.
        self.timed_out = self.timed_out or (self._ends is not None and time.monotonic() >= self._ends)
        return self.spent < self.nodes and not self.timed_out

    def run(self, tree: Tree, go_on: Callable[[Tree], bool]) -> None:
        """Run `tree` while there is work left and `go_on` holds."""
        before, spent = tree.nodes, self.spent

        def within(tree: Tree) -> bool:
            self.spent = spent + tree.nodes - before
            return self.left() and go_on(tree)

        try:
            tree.run(within)
        finally:
            self.spent = spent + tree.nodes - before


class Shares:
    """The `nodes` of a round, shared out among trees that are run one after the other, region by region."""

    def __init__(self, budget: Budget, nodes: int, passed: Callable[[float], bool]) -> None:
        self._budget, self._ends, self._passed = budget, budget.spent + nodes, passed
        self.closed = True

    def run(self, done: int, regions: int, tree: Tree) -> None:
        """Run a tree of the next region, `done` of all `regions` being done.

        With 60 of 100 regions done and 800 nodes left, it has 800 / 40 = 20: what it leaves over goes to the others.
        """
        self._passed(done / regions)
        most = (self._ends - self._budget.spent) / (regions - done)
        self._budget.run(tree, lambda tree: tree.nodes < most)
        self.closed = self.closed and tree.closed
