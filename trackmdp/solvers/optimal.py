"""The optimal policy, with a proof: policy iteration over located cells, the inner search by branch and bound.

With V the value of the policy at hand and T the Bellman operator over renewals, the residual eps = T V - V >= 0
bounds the optimum: V* <= V + (I - P)^-1 eps, because the motion does not depend on the sensing, so that eps is met at
most once in every step of the target's path.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from trackmdp.solvers import clocked, search
from trackmdp.solvers.bounds import clocked_table
from trackmdp.solvers.branch import Tree
from trackmdp.solvers.chains import evaluate
from trackmdp.solvers.known import next_table
from trackmdp.solvers.layers import Layer, build, chains_to_sets, sets_to_chains
from trackmdp.solvers.renewal import accumulate, expected_steps
from trackmdp.solvers.search import InnerProblem
from trackmdp.world.model import Array, BoolArray, World

__all__ = ["Progress", "Solution", "bracketed", "solve"]

ROUNDING = 1e-10
"""Relative gap that is not told from rounding, whatever the tolerance."""
FIRST_NODES = 100_000
"""Nodes before the first round's improvements are used; twice as many in each later round. Not seconds, so that the
same world gives the same policy on any machine."""
WORTH_A_RESTART = 0.02
"""Share of the bracket that improvements have to close for the search to start anew with them."""


@dataclass(frozen=True)
class Solution:
    """The best policy found and what is proved about it.

    Attributes:
        chains: `[M, t_max + 1, M]`, the policy.
        value: `[M]`, its exact value; V*(x) >= value[x].
        bound: `[M]`, proved: V*(x) <= bound[x].
        certified: whether the means of `value` and `bound` agree within the tolerance.
        seconds: time spent.
        nodes: branch-and-bound choices looked at.
        interrupted: whether the user stopped the search (Ctrl-C).
    """

    chains: BoolArray
    value: Array
    bound: Array
    certified: bool
    seconds: float
    nodes: int
    interrupted: bool

    @property
    def lower(self) -> float:
        """The policy's AIHTR."""
        return float(self.value.mean())

    @property
    def upper(self) -> float:
        """No policy has a higher AIHTR."""
        return float(self.bound.mean())


@dataclass(frozen=True)
class Progress:
    """How far a search has come: the bracket around the optimal AIHTR, and seconds and nodes so far."""

    lower: float
    upper: float
    seconds: float
    nodes: int


def solve(
    world: World,
    *,
    time_limit: float = 60.0,
    tolerance: float = 1e-6,
    on_progress: Callable[[Progress], None] | None = None,
) -> Solution:
    """Search until the bracket is closed to `tolerance` of the value, or `time_limit` seconds are over.

    Ctrl-C ends the search like the time limit does: the bracket reached so far is returned.
    """
    run = _Run(world, time_limit, tolerance, on_progress)
    interrupted = False
    try:
        run.search()
    except KeyboardInterrupt:
        interrupted = True
    return run.solution(interrupted)


def bracketed(world: World, chains: BoolArray, seconds: float, tolerance: float = 1e-6) -> Solution:
    """A policy found in another way, in `seconds`, with the clocked bound as what is proved."""
    value = evaluate(world, chains).value
    bound = np.maximum(clocked_table(world).value, value)
    certified = float((bound - value).mean()) <= tolerance * max(1.0, abs(float(value.mean())))
    return Solution(chains, value, bound, certified, seconds, nodes=0, interrupted=False)


class _Run:
    """One search: the policy and the bracket so far."""

    def __init__(
        self,
        world: World,
        time_limit: float,
        tolerance: float,
        on_progress: Callable[[Progress], None] | None,
    ) -> None:
        self.world, self.tolerance, self.on_progress = world, tolerance, on_progress
        self.started = time.monotonic()
        self.ends = self.started + time_limit
        self.layers: list[Layer] = build(world, world.num_choices)
        table = clocked_table(world)
        self.bound = table.value
        self.longest = float(expected_steps(world).max())
        self.nodes = 0
        self.chains = clocked.solve(world, table=table.table)
        self.value = evaluate(world, self.chains).value

    def use(self, chains: BoolArray) -> bool:
        """Take `chains` as the policy at hand if it is better."""
        value = evaluate(self.world, chains).value
        better = bool(value.sum() > self.value.sum())
        if better:
            self.chains, self.value = chains, value
        return better

    @property
    def gap_allowed(self) -> float:
        return max(self.tolerance, ROUNDING) * max(1.0, abs(float(self.value.mean())))

    @property
    def slack(self) -> float:
        """Improvements of one renewal below this cannot add up to more than half of the gap allowed."""
        return 0.5 * self.gap_allowed / self.longest

    @property
    def certified(self) -> bool:
        return float((self.bound - self.value).mean()) <= self.gap_allowed

    def report(self) -> None:
        if self.on_progress is not None:
            seconds = time.monotonic() - self.started
            self.on_progress(Progress(float(self.value.mean()), float(self.bound.mean()), seconds, self.nodes))

    def search(self) -> None:
        self.use(search.solve(self.world))
        self.report()
        patience = FIRST_NODES
        while not self.certified and time.monotonic() < self.ends:
            improved = self.round(patience)
            self.report()
            if not improved:
                return
            patience *= 2

    def round(self, patience: int) -> bool:
        """Search the renewals of the policy at hand; whether a better policy was found."""
        problem = InnerProblem.of(self.world, self.layers, self.value)
        revealed = [problem.missed]
        for length in range(1, self.world.num_choices):
            revealed.append(self.revealed(problem, revealed, length, patience))
        tree = Tree(self.world, problem.detected, revealed, self.value, self.slack)
        try:
            self.explore(tree, patience)
        finally:  # what was found and proved is kept when the user interrupts as well
            self.tighten(tree)
            improved = self.adopt(tree)
        return improved

    def adopt(self, tree: Tree) -> bool:
        """Use the better chains that the tree has found; whether the policy is better with them."""
        if not tree.improvements():
            return False
        chains = self.chains.copy()
        for x, steps in tree.improvements().items():
            chains[x] = _sets_without(self.world, x, steps)
        sets = search.improve(self.world, self.layers, chains_to_sets(self.layers, chains))
        return self.use(sets_to_chains(self.world, self.layers, sets))

    def explore(self, tree: Tree, patience: int) -> None:
        """Until the tree is closed or time is over.

        After `patience` nodes, improvements that close a good part of the bracket end it too: what is proved for a
        better policy is worth more, but all that is proved for this one has to be proved anew.
        """
        reported, next_look = time.monotonic(), patience

        def go_on(tree: Tree) -> bool:
            nonlocal reported, next_look
            now = time.monotonic()
            if now - reported > 1.0:
                reported = now
                self.tighten(tree)
                self.report()
            if tree.nodes >= next_look:
                next_look += patience
                self.tighten(tree)
                gained = accumulate(self.world.kernel, tree.best - self.value).mean()
                if gained > WORTH_A_RESTART * float((self.bound - self.value).mean()):
                    return False
            return now < self.ends

        before = tree.nodes
        tree.run(go_on)
        self.nodes += tree.nodes - before

    def tighten(self, tree: Tree) -> None:
        """Use what the tree has proved so far."""
        residual = np.maximum(tree.upper() - self.value, 0.0)
        self.bound = np.minimum(self.bound, self.value + accumulate(self.world.kernel, residual))

    def revealed(self, problem: InnerProblem, known: list[Array], length: int, patience: int) -> Array:
        """`[M]` upper bound of what `length` more sets can earn with the target known to be in each cell."""
        inner = InnerProblem(self.world, self.layers[: length + 1], problem.detected, problem.missed)
        tree = next_table(inner, known, self.slack)
        tree.run(lambda tree: tree.nodes < patience and time.monotonic() < self.ends)
        self.nodes += tree.nodes
        return tree.upper()

    def solution(self, interrupted: bool) -> Solution:
        seconds = time.monotonic() - self.started
        bound = np.maximum(self.bound, self.value)
        return Solution(self.chains, self.value, bound, self.certified, seconds, self.nodes, interrupted)


def _sets_without(world: World, x: int, steps: list[set[int]]) -> BoolArray:
    """`[t_max + 1, M]` the chain from x that senses every possible cell but those left out at each step."""
    chain = np.zeros((world.num_choices, world.num_cells), dtype=bool)
    mass = np.eye(world.num_cells)[x]
    for n, left in enumerate(steps):
        mass = mass @ world.kernel
        chain[n] = mass > 0
        chain[n, sorted(left)] = False
        mass = np.where(chain[n], 0.0, mass)
    return chain
