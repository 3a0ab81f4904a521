"""The optimal policy, with a proof: policy iteration over located cells, the inner search by branch and bound.

With V the value of the policy at hand and T the Bellman operator over renewals, the residual eps = T V - V >= 0
bounds the optimum: V* <= V + (I - P)^-1 eps. For T V <= V + eps gives V* - V <= K* (V* - V) + eps, K* the moves from
one detection to the next under the optimal policy, so V* - V <= (I - K*)^-1 eps; and since sensing does not move the
target, the located cells of any policy are some of the cells on its path, each counted by (I - P)^-1.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from trackmdp.errors import UserError
from trackmdp.policies.table import PolicyTable
from trackmdp.solvers import clocked, search
from trackmdp.solvers.bounds import clocked_table
from trackmdp.solvers.branch import Tree
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.evaluation import Evaluation
from trackmdp.solvers.known import next_table
from trackmdp.solvers.layers import Layer, layer_sets, policy_table, reachable_layers
from trackmdp.solvers.renewal import RenewalSystem, expected_steps
from trackmdp.solvers.search import InnerProblem, follow_credit
from trackmdp.solvers.solution import SearchProgress, Solution
from trackmdp.world.model import Array, World

__all__ = ["solve"]

ROUNDING = 1e-10
"""Relative gap that is not told from rounding, whatever the tolerance."""
FIRST_NODES = 100_000
"""Nodes before the first round's improvements are used; twice as many in each later round. Not seconds, so that the
same world gives the same policy on any machine."""
WORTH_A_RESTART = 0.02
"""Share of the bracket that improvements have to close for the search to start anew with them."""


def solve(
    world: World,
    *,
    time_limit: float = 60.0,
    tolerance: float = 1e-6,
    on_progress: Callable[[SearchProgress], None] | None = None,
) -> Solution:
    """Search until the bracket is closed to `tolerance` of the value, or `time_limit` seconds are over.

    Where the clocked policy attains the clocked bound, as it does wherever at most one possible cell is ever left
    unsensed, nothing is searched. Ctrl-C ends a search like the time limit does: the bracket so far is returned.
    """
    if world.max_steps is not None:
        raise UserError(f"grid.max_steps={world.max_steps}: only whole episodes are solved, expected null")
    run = _Run(world, time_limit, tolerance, on_progress)
    interrupted = False
    try:
        run.search()
    except KeyboardInterrupt:
        interrupted = True
    return run.solution(interrupted)


@dataclass
class _Ground:
    """What every round uses, built once there is a search: layers, the system I - P, the longest expected episode."""

    world: World
    layers: list[Layer] = field(init=False)
    paths: RenewalSystem = field(init=False)
    longest: float = field(init=False)

    def __post_init__(self) -> None:
        self.layers = reachable_layers(self.world, self.world.num_choices)
        self.paths = RenewalSystem(self.world.kernel, self.world.size)
        self.longest = float(expected_steps(self.world).max())


class _Run:
    """One search: the policy and the bracket so far."""

    def __init__(
        self,
        world: World,
        time_limit: float,
        tolerance: float,
        on_progress: Callable[[SearchProgress], None] | None,
    ) -> None:
        self.world, self.tolerance, self.on_progress = world, tolerance, on_progress
        self.started = time.monotonic()
        self.ends = self.started + time_limit
        # U(x, 0) >= V*(x) before anything is searched; `tighten` only lowers it.
        self.bound = clocked_table(world).value
        self.nodes = 0
        self.policy = clocked.solve(world)
        self.evaluation: Evaluation = evaluate(world, self.policy)

    @property
    def value(self) -> Array:
        """`[M]`, of the policy at hand."""
        return self.evaluation.value

    def use(self, policy: PolicyTable) -> bool:
        """Take `policy` as the one at hand if it is better."""
        evaluation = evaluate(self.world, policy)
        better = bool(evaluation.value.sum() > self.value.sum())
        if better:
            self.policy, self.evaluation = policy, evaluation
        return better

    @property
    def gap_allowed(self) -> float:
        return max(self.tolerance, ROUNDING) * max(1.0, abs(float(self.value.mean())))

    @property
    def certified(self) -> bool:
        return float((self.bound - self.value).mean()) + self.evaluation.error <= self.gap_allowed

    def report(self) -> None:
        if self.on_progress is not None:
            seconds = time.monotonic() - self.started
            self.on_progress(SearchProgress(float(self.value.mean()), float(self.bound.mean()), seconds, self.nodes))

    def search(self) -> None:
        if self.certified:  # the clocked policy attains its bound
            self.report()
            return
        self.ground = _Ground(self.world)
        layers = self.ground.layers
        # first the policy, then the proof: branch and bound is the faster the better its start
        self.use(policy_table(self.world, layers, follow_credit(self.world, layers, layer_sets(layers, self.policy))))
        self.report()
        patience = FIRST_NODES
        while not self.certified and time.monotonic() < self.ends:
            improved = self.round(patience)
            self.report()
            # No better plan: the tree was searched to its end, or time is over.
            if not improved:
                return
            patience *= 2

    def round(self, patience: int) -> bool:
        """Search the renewals of the policy at hand; whether a better policy was found."""
        # Improvements of one renewal below the slack cannot add up to more than half of the gap allowed: a path of
        # `longest` expected steps has at most as many renewals.
        slack = 0.5 * self.gap_allowed / self.ground.longest
        problem = InnerProblem.of(self.world, self.ground.layers, self.value)
        # R_1, R_2, ...: what 1, 2, ... more sets are worth from a known position, each from those before
        revealed = [problem.missed]
        for length in range(1, self.world.num_choices):
            revealed.append(self.revealed(problem, revealed, length, patience, slack))
        tree = Tree(self.world, problem.detected, revealed, self.value, slack)
        try:
            self.explore(tree, patience)
        finally:  # what was found and proved is kept when the user interrupts as well
            self.tighten(tree)
            improved = self.adopt(tree)
        return improved

    def adopt(self, tree: Tree) -> bool:
        """Use the better plans that the tree has found; whether the policy is better with them."""
        better, left = tree.improvements()
        if not better.any():
            return False
        layers, mass, sets = self.ground.layers, np.ones(self.world.num_cells), []
        for layer, on, out in zip(layers[1:], layer_sets(layers, self.policy), left, strict=True):
            mass = mass @ layer.moves
            # a plan of the tree senses every possible cell but those left out
            sets.append(np.where(better[layer.rows], (mass > 0) & ~out.has(layer.rows, layer.cells), on))
            mass = mass * (1.0 - sets[-1] * self.world.detects(layer.cells))
        return self.use(policy_table(self.world, layers, search.improve(self.world, layers, sets)))

    def explore(self, tree: Tree, patience: int) -> None:
        """Run the tree until it is closed or the time limit is reached.

        Every `patience` nodes it also ends if the improvements found close a good part of the bracket: the next round
        starts from a better policy, but most of what this tree has ruled out has to be ruled out again.
        """
        reported, next_look = time.monotonic(), patience

        def go_on(tree: Tree) -> bool:
            nonlocal reported, next_look
            now = time.monotonic()
            # the clock decides what is shown and when the search ends, never which plan is looked at next
            if now - reported > 1.0:
                reported = now
                self.tighten(tree)
                self.report()
            if tree.nodes >= next_look:
                next_look += patience
                self.tighten(tree)
                gained = self.ground.paths.solve(tree.best - self.value).mean()
                if gained > WORTH_A_RESTART * float((self.bound - self.value).mean()):
                    return False
            return now < self.ends

        before = tree.nodes
        tree.run(go_on)
        self.nodes += tree.nodes - before

    def tighten(self, tree: Tree) -> None:
        """Use what the tree has proved so far: V* <= V + (I - P)^-1 (T V - V), for any V, also one off by its error."""
        # The tree bounds T V from above, cell by cell, also where it was stopped early. The clocked bound and all that
        # earlier rounds proved hold as well: the least of them is kept, cell by cell.
        residual = np.maximum(tree.upper() - self.value, 0.0)
        met = self.ground.paths.upper(residual, self.ground.longest)
        self.bound = np.minimum(self.bound, self.value + met)

    def revealed(self, problem: InnerProblem, known: list[Array], length: int, patience: int, slack: float) -> Array:
        """`[M]` upper bound of what `length` more sets can earn with the target known to be in each cell."""
        inner = InnerProblem(self.world, self.ground.layers[: length + 1], problem.detected, problem.missed)
        tree = next_table(inner, known, slack)
        tree.run(lambda tree: tree.nodes < patience and time.monotonic() < self.ends)
        self.nodes += tree.nodes
        return tree.upper()

    def solution(self, interrupted: bool) -> Solution:
        seconds = time.monotonic() - self.started
        bound = np.maximum(self.bound, self.value)
        return Solution(self.policy, self.evaluation, bound, self.certified, seconds, self.nodes, interrupted)
