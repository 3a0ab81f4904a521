"""The work that a search may do, counted in nodes of branch and bound."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from trackmdp.solvers.certify.branch import Tree


class Budget:
    """Work that may be done, in nodes, and that was; the clock is only read where a time limit is set."""

    def __init__(self, nodes: int, time_limit: float | None) -> None:
        self.nodes, self.spent, self.timed_out = nodes, 0, False
        self.started = time.monotonic()
        self._ends = None if time_limit is None else self.started + time_limit

    @property
    def seconds(self) -> float:
        """Until the time limit; inf without one."""
        return math.inf if self._ends is None else max(0.0, self._ends - time.monotonic())

    def left(self) -> bool:
        """Whether there is work left to do."""
        # A limit that has passed stays passed: the rounds after it end one by one.
        self.timed_out = self.timed_out or (
            self._ends is not None and time.monotonic() >= self._ends
        )
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

        With 60 of 100 regions done and 800 nodes left, it has 800 / 40 = 20; unused nodes go to the others.
        """
        self._passed(done / regions)
        most = (self._ends - self._budget.spent) / (regions - done)
        self._budget.run(tree, lambda tree: tree.nodes < most)
        self.closed = self.closed and tree.closed
