"""The optimal policy, with a proof: policy iteration over located cells, the inner search by branch and bound.

With V the value of the policy at hand, a plan nu from x is worth at most V(x) + eps_nu and leads to the next located
cell by K_nu: V* - V <= max_nu eps_nu + K_nu (V* - V). Let the target pay e(X_s) >= 0 at every step s, located or not:
phi = (I - P)^-1 e is what a path pays, whatever is sensed, and phi = e(x) + sum_t z_t e + K_nu phi, z_t the undetected
mass after the t-th set of nu. If e(x) + sum_t z_t e >= eps_nu for every plan that is not ruled out, then phi >= max_nu
eps_nu + K_nu phi, hence V* <= V + phi. With e = max_nu eps_nu the inequality holds; what is paid between two detections
lets e be less.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from trackmdp.errors import UserError
from trackmdp.policies.table import PolicyTable
from trackmdp.solvers import qmdp
from trackmdp.solvers.bounds import exact_clocked_table
from trackmdp.solvers.branch import Tree
from trackmdp.solvers.budget import Budget, Shares
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.evaluation import Evaluation
from trackmdp.solvers.exchange import best_of, exchanged, other_starts
from trackmdp.solvers.known import planted
from trackmdp.solvers.layers import Layer, layer_sets, policy_table, reachable_layers
from trackmdp.solvers.regions import adopted, improved, proved, region_side
from trackmdp.solvers.renewal import RenewalSystem, expected_steps
from trackmdp.solvers.search import InnerProblem, follow_credit
from trackmdp.solvers.solution import SearchProgress, Solution
from trackmdp.solvers.two_sets import best_plans
from trackmdp.world.model import Array, BoolArray, World

ROUNDING = 1e-10
"""Relative gap that is not told from rounding, whatever the tolerance."""
FIRST_NODES = 100_000
"""Nodes before the first round's improvements are used; twice as many in each later round. Not seconds, so that the
same world gives the same policy on any machine."""
NODES_BETWEEN_REPORTS = 100_000
"""Nodes after which the bracket is brought up to date while a tree is searched: about a second's."""
RESTARTS = 16
"""Searches from other starts where the first tree leaves the bracket open."""
NODES_A_CELL = 4
"""Nodes before improvements are used in regions, for each cell of the grid: more than most regions need."""
WORTH_A_ROUND = 0.02
"""Share of the bracket that a round of ascent and exchange has to close to be followed by another one."""
WORTH_A_RESTART = 0.02
"""Share of the bracket that improvements have to close for the search to start anew with them."""


def solve(
    world: World,
    *,
    nodes: int = 5_000_000,
    time_limit: float | None = None,
    tolerance: float = 1e-6,
    memory: str | None = None,
    start: PolicyTable | None = None,
    on_progress: Callable[[SearchProgress], None] | None = None,
) -> Solution:
    """Search until the bracket is closed to `tolerance` of the value, or `nodes` are looked at.

    The budget is work, so that a world has the same bracket on a busy and on an idle machine. Where the clocked policy
    attains the clocked bound, as it does wherever at most one possible cell is ever left unsensed, nothing is
    searched. Ctrl-C ends a search like the budget does: the bracket so far is returned. Where sensors have footprints
    there is no tree: up to t_max = 1 all plans are gone through (`two_sets`), above the bracket is that of policy
    iteration, with the best set at each step, and of the clocked bound.

    Args:
        world: the problem with its motion model.
        nodes: choices of branch and bound, all trees together; some 100,000 a second.
        time_limit: seconds after which to stop before; what is returned then depends on the machine, and says so
            (`Solution.timed_out`). None: no limit.
        tolerance: bracket that counts as closed, relative to the value.
        memory: bytes that may be used, about, such as ``"2GiB"``; None: what the machine has left. A grid that needs
            more, or has more than 20,000 cells, is searched region by region.
        start: a deterministic policy that is known, such as a learned one: what is returned is no worse.
        on_progress: told how far the search has come.
    """
    if world.max_steps is not None:
        raise UserError(f"grid.max_steps={world.max_steps}: only whole episodes are solved, expected null")
    side = region_side(world, memory)
    # Sensors with footprints have no tree, and so no regions.
    side = side if world.coverage is None else None
    run = _Run(world, Budget(nodes, time_limit), tolerance, start, on_progress, side)
    interrupted = False
    try:
        run.search()
    except KeyboardInterrupt:
        interrupted = True
    return run.solution(interrupted)


@dataclass(eq=False)
class _Run:
    """One search: the policy and the bracket so far."""

    world: World
    budget: Budget
    tolerance: float
    start: PolicyTable | None
    on_progress: Callable[[SearchProgress], None] | None
    side: int | None
    restarted: bool = False
    found: PolicyTable | None = None

    def __post_init__(self) -> None:
        # U(x, 0) >= V*(x) before anything is searched; `tighten` only lowers it.
        self.bound = exact_clocked_table(self.world).value
        self.policy = qmdp.clocked_policy(self.world)
        self.evaluation: Evaluation = evaluate(self.world, self.policy, guess=self.bound, per_cell=False)

    @property
    def value(self) -> Array:
        """`[M]`, of the policy at hand."""
        return self.evaluation.value

    def use(self, policy: PolicyTable) -> bool:
        """Take `policy` as the one at hand if it is better."""
        evaluation = evaluate(self.world, policy, guess=self.value, per_cell=False)
        # By more than rounding, so that another way to write the same policy changes nothing.
        better = bool(evaluation.value.sum() > self.value.sum() + 1e-13 * np.abs(self.value).sum())
        if better:
            self.policy, self.evaluation = policy, evaluation
        return better

    @cached_property
    def layers(self) -> list[Layer]:
        """Where plans of the whole grid are made: not there where it is searched region by region."""
        return reachable_layers(self.world, self.world.num_choices)

    @cached_property
    def paths(self) -> RenewalSystem:
        return RenewalSystem(self.world.kernel, self.world.size)

    @cached_property
    def longest(self) -> float:
        return float(expected_steps(self.world).max())

    @property
    def gap_allowed(self) -> float:
        return max(self.tolerance, ROUNDING) * max(1.0, abs(float(self.value.mean())))

    @property
    def slack(self) -> float:
        # Improvements of one renewal below the slack cannot add up to more than half of the gap allowed: a path of
        # `longest` expected steps has at most as many renewals.
        return 0.5 * self.gap_allowed / self.longest

    @property
    def certified(self) -> bool:
        return float((self.bound - self.value).mean()) + self.evaluation.error <= self.gap_allowed

    def open(self) -> bool:
        """Whether there is something left to prove, and work left to do it."""
        return not self.certified and self.budget.left()

    def report(self, stage: str = "", left: float | None = None) -> None:
        if self.on_progress is not None:
            bracket = float(self.value.mean()), float(self.bound.mean())
            seconds, nodes = time.monotonic() - self.budget.started, self.budget.spent
            self.on_progress(SearchProgress(*bracket, seconds, nodes, stage, left))

    def search(self) -> None:
        if self.certified:  # the clocked policy attains its bound
            self.report()
            return
        if self.side is not None:
            self.search_regions(self.side)
            return
        layers = self.layers
        # first the policy, then the proof: branch and bound is the faster the better its start
        self.use(policy_table(self.world, layers, follow_credit(self.world, layers, layer_sets(layers, self.policy))))
        if self.world.coverage is None:
            self.use(self.exchanged(layer_sets(layers, self.policy)))
        # Last: what the search finds by itself is the same whatever is handed to it.
        if self.start is not None:
            self.use(self.start)
        self.report()
        patience = FIRST_NODES
        # The tree decides which cells to leave out, one by one, and knows no sensors that cover several.
        while self.open():
            improved = self.round(patience) if self.world.coverage is None else self.covered_round()
            self.report()
            # No better plan: the tree was searched to its end, or the budget is spent.
            if not improved:
                return
            patience *= 2

    def search_regions(self, side: int) -> None:
        """The same with the layers of one region of `side` x `side` located cells at a time.

        Ascent and exchange, with V made anew after each round, end where the homotopy does, within a few rounds.
        """
        patience = max(FIRST_NODES, NODES_A_CELL * self.world.num_cells)
        while self.open():
            self.improve_regions(side)
            # Last: what the search finds by itself is the same whatever is handed to it.
            if self.start is not None:
                self.use(self.start)
            if not self.open():
                return
            shares = Shares(self.budget, patience, self.clock("branch and bound"))
            # e(x) = eps_x pays for every plan of x (see the module), and asks for one tree at a time; `payment` asks
            # for all of them at once.
            short, policy = proved(self.world, self.policy, self.value, side, self.slack, shares.run)
            self.pay(short)
            better = self.use(policy)
            self.report()
            # All trees were searched to their ends and hold no better plan: more nodes would change nothing.
            if shares.closed and not better:
                return
            patience *= 2

    def improve_regions(self, side: int) -> None:
        """Rounds of ascent and exchange, until one closes little of what was open before the first."""
        gap = gained = float((self.bound - self.value).mean())
        while gained > WORTH_A_ROUND * gap and self.open():
            before, passed = float(self.value.mean()), self.clock("policy iteration")
            self.use(improved(self.world, self.policy, self.value, side, passed))
            gained = float(self.value.mean()) - before
            self.report()

    def clock(self, stage: str) -> Callable[[float], bool]:
        """Told the share of a round that is done, it reports how long the rest will take; whether to go on."""
        began = time.monotonic()

        def passed(share: float) -> bool:
            if share:
                self.report(stage, (time.monotonic() - began) * (1.0 / share - 1.0))
            return self.budget.left()

        return passed

    def restart(self) -> bool:
        """Search from other starts; whether that gave a better policy, to be used next."""
        world, layers = self.world, self.layers
        sets, others = layer_sets(layers, self.policy), other_starts(world, layers, RESTARTS)
        found = policy_table(world, layers, best_of(world, layers, sets, others, self.value, go_on=self.budget.left))
        better = evaluate(world, found, guess=self.value).value.sum() > self.value.sum()
        self.found = found if better else None
        return better

    @property
    def problem(self) -> InnerProblem:
        """The search from each located cell, over the policy at hand."""
        return InnerProblem.of(self.world, self.layers, self.value)

    def round(self, patience: int) -> bool:
        """Search the renewals of the policy at hand; whether a better policy was found."""

        def run(tree: Tree) -> None:
            self.budget.run(tree, lambda tree: tree.nodes < patience)

        tree = planted(self.problem, self.value, self.slack, run)
        try:
            self.explore(tree, patience)
        finally:  # what was found and proved is kept when the user interrupts as well
            self.tighten(tree)
            improved = self.adopt(tree)
            # only here: until then the tree's bounds are those over the policy it was grown from
            if self.found is not None:
                improved = self.use(self.found) or improved
                self.found = None
        return improved

    def covered_round(self) -> bool:
        """As `round`, by `two_sets`."""
        if self.world.num_choices != 2:
            return False

        def looked_at(plans: int) -> bool:
            self.budget.spent += plans
            return self.budget.left()

        found = best_plans(self.problem, layer_sets(self.layers, self.policy), self.slack, looked_at)
        if found is None:
            return False
        self.pay(np.maximum(found[0] - self.value, 0.0))  # e(x) = eps_x pays for every plan of x (see the module)
        return self.use(policy_table(self.world, self.layers, found[1]))

    def adopt(self, tree: Tree) -> bool:
        """Use the better plans that the tree has found; whether the policy is better with them."""
        sets = adopted(self.problem, layer_sets(self.layers, self.policy), tree)
        return sets is not None and self.use(self.exchanged(sets))

    def exchanged(self, sets: list[BoolArray]) -> PolicyTable:
        """The policy that exchange makes of `sets`."""
        better = exchanged(self.world, self.layers, sets, go_on=self.budget.left)
        return policy_table(self.world, self.layers, better)

    def explore(self, tree: Tree, patience: int) -> None:
        """Run the tree until it is closed or the budget is spent.

        Every `patience` nodes it also ends if the improvements found close a good part of the bracket: the next round
        starts from a better policy, but most of what this tree has ruled out has to be ruled out again.
        """
        # Nodes, not seconds, also between two reports: `tighten` takes the least of what it is shown.
        step = max(NODES_BETWEEN_REPORTS, 10 * self.world.num_cells)
        next_report, next_look = step, patience

        def go_on(tree: Tree) -> bool:
            nonlocal next_report, next_look
            if tree.nodes >= next_report:
                next_report = tree.nodes + step
                self.tighten(tree)
                self.report()
            if tree.nodes >= next_look:
                next_look += patience
                self.tighten(tree)
                gained = self.paths.solve(tree.best - self.value).mean()
                if not self.restarted:
                    self.restarted = True
                    if self.restart():
                        return False
                if gained > WORTH_A_RESTART * float((self.bound - self.value).mean()):
                    return False
            return True

        self.budget.run(tree, go_on)

    def tighten(self, tree: Tree) -> None:
        """Use what the tree has proved so far, for any V, also one off by its error."""
        self.pay(payment(tree, self.value))

    def pay(self, paid: Array) -> None:
        """Use a proof that `paid` `[M]`, the e of the module's text, pays for every plan over the policy at hand."""
        # The clocked bound and all that earlier rounds proved hold as well: the least of them is kept, cell by cell.
        self.bound = np.minimum(self.bound, self.value + self.paths.upper(paid, self.longest))

    def solution(self, interrupted: bool) -> Solution:
        bound, certified = np.maximum(self.bound, self.value), self.certified
        seconds, timed_out = time.monotonic() - self.budget.started, self.budget.timed_out and not certified
        return Solution(
            self.policy, self.evaluation, bound, certified, seconds, self.budget.spent, interrupted, timed_out
        )


def payment(tree: Tree, value: Array) -> Array:
    """`[M]` e >= 0 with e(x) + sum_t z_t e >= eps_nu for each plan nu of x, whatever part of the tree was searched."""
    # `rate` falls where e rises. rate(0) will do, and with e also rate(rate(e)) <= e: from e >= rate(e) follows
    # rate(e) <= rate(rate(e)), and from that rate(rate(rate(e))) <= rate(rate(e)).
    paid = np.maximum(tree.rate(value, np.zeros_like(value)), 0.0)
    for _ in range(2):
        least = np.maximum(tree.rate(value, paid), 0.0)
        paid = np.maximum(tree.rate(value, least), 0.0)
    return paid
