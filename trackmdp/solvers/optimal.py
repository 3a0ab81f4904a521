"""The optimal policy, with a proof: policy iteration over located cells, the inner search by branch and bound.

With V the value of the policy at hand, a plan nu from x is worth at most V(x) + eps_nu and leads to the next located
cell by K_nu: V* - V <= max_nu eps_nu + K_nu (V* - V). Let the target pay e(X_s) >= 0 at every step s, located or not:
phi = (I - P)^-1 e is the payment of a path under every policy, and phi = e(x) + sum_t z_t e + K_nu phi, z_t the
undetected mass after the t-th set of nu. If e(x) + sum_t z_t e >= eps_nu for every plan that is not ruled out, then
phi >= max_nu eps_nu + K_nu phi, hence V* <= V + phi. With e = max_nu eps_nu the inequality holds; the payments between
two detections let e be less.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from trackmdp.arrays.types import Array
from trackmdp.errors import UserError
from trackmdp.policies.table import PolicyTable
from trackmdp.solvers import exchange
from trackmdp.solvers.bounds import exact_clocked_table, of_cells
from trackmdp.solvers.certify.branch import Tree
from trackmdp.solvers.certify.budget import Budget, Shares
from trackmdp.solvers.certify.inner import InnerProblem
from trackmdp.solvers.certify.known import adopted, planted
from trackmdp.solvers.certify.listing import best_plans
from trackmdp.solvers.evaluation import Evaluation
from trackmdp.solvers.exchange import best_of, exchanged, other_starts, revealed
from trackmdp.solvers.linear import DIRECT_CELLS, RenewalSystem
from trackmdp.solvers.motion_totals import expected_steps, forced_worth, grid_of
from trackmdp.solvers.regions import improved, proved, region_side, settled, widest_side
from trackmdp.solvers.renewal import Renewal
from trackmdp.solvers.rules import clocked_policy
from trackmdp.solvers.search import Found, clocked_sets, follow_credit
from trackmdp.solvers.solution import OnProgress, SearchProgress, Solution, unit
from trackmdp.solvers.value import value_of
from trackmdp.world.model import World

ROUNDING = 1e-10
"""Relative gap that counts as rounding, at any tolerance."""
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
_ROUNDS = 5
"""Of ascent and exchange without a proof, at most: the first three gain nearly all."""
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
    on_progress: OnProgress = None,
) -> Solution:
    """Search until the bracket is closed to `tolerance` of the value, or `nodes` are looked at.

    The budget is work, so that a world has the same bracket on a busy and on an idle machine. Where the clocked policy
    attains the clocked bound, as it does wherever at most one possible cell is ever left unsensed, nothing is
    searched. Ctrl-C ends a search like the budget does: the bracket so far is returned. The tree decides cell by cell:
    where sensors have footprints or a budget, or a detection reveals a mode, plans are listed (`listing`) as far as
    there are few, else the bracket is between policy iteration, with the best set at each step, and the clocked bound.

    Args:
        world: the problem with its motion model; a detection reveals the whole state.
        nodes: choices of branch and bound, all trees together; some 100,000 a second.
        time_limit: seconds after which to stop before; the result then depends on the machine, and has
            `Solution.timed_out`. None: no limit.
        tolerance: bracket that counts as closed, relative to the value.
        memory: bytes that may be used, about, such as ``"2GiB"``; None: the machine's free memory. A grid that needs
            more, or has more than 20,000 cells, is searched region by region.
        start: a deterministic policy that is known, such as a learned one: the result is no worse. One that
            remembers more than a detection reveals is left out.
        on_progress: called with the progress of the search.
    """
    if world.max_steps is not None:
        raise UserError(
            f"grid.max_steps={world.max_steps}: only whole episodes are solved, expected null"
        )
    if world.memory != "cell":  # the state is known at a detection: more of the past is of no use
        world = world.but(memory="cell")
    if start is not None and (start.task.order or start.task.num_keys != world.num_keys):
        start = None
    # There are no regions without a tree.
    side = region_side(world, memory) if has_trees(world) else None
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
    on_progress: OnProgress
    side: int | None
    restarted: bool = False
    other: PolicyTable | None = None

    def __post_init__(self) -> None:
        # U(z, 0) >= V*(z) before anything is searched; `tighten` only lowers it.
        self.bound = exact_clocked_table(self.world).value
        self.trees = has_trees(self.world)
        if self.world.modes == 1:
            self.policy = clocked_policy(self.world)
        else:
            self.policy = self.renewal.table(clocked_sets(self.renewal))
        self.evaluation = self.valued(self.policy, self.bound)

    def valued(self, policy: PolicyTable, guess: Array) -> Evaluation:
        return value_of(self.world, policy, guess=guess)

    @property
    def value(self) -> Array:
        """`[Z]`, of the policy at hand."""
        return self.evaluation.starts

    def use(self, policy: PolicyTable) -> bool:
        """Take `policy` as the one at hand if it is better."""
        evaluation = self.valued(policy, self.value)
        # By more than rounding, so that another way to write the same policy changes nothing.
        better = bool(evaluation.starts.sum() > self.value.sum() + 1e-13 * np.abs(self.value).sum())
        if better:
            self.policy, self.evaluation = policy, evaluation
        return better

    @cached_property
    def renewal(self) -> Renewal:
        """Plans of the whole grid: not there where it is searched region by region."""
        return Renewal(self.world, self.world.motion)

    @property
    def here(self) -> Found:
        """The policy at hand."""
        return Found(self.renewal, self.renewal.sets(self.policy))

    @cached_property
    def paths(self) -> RenewalSystem:
        return RenewalSystem(self.world.kernel, grid_of(self.world))

    @cached_property
    def longest(self) -> float:
        return float(expected_steps(self.world).max())

    @property
    def gap_allowed(self) -> float:
        return max(self.tolerance, ROUNDING) * unit(self.world, float(self.value.mean()))

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
            left = None if left is None else min(left, self.budget.seconds)
            self.on_progress(SearchProgress(*bracket, seconds, nodes, stage, left))

    def search(self) -> None:
        if self.certified:  # the clocked policy attains its bound
            self.report()
            return
        if self.side is not None:
            self.search_regions(self.side)
            return
        # First the policy, then the proof: branch and bound is the faster the better its start.
        self.use(follow_credit(self.here, go_on=self.budget.left).table)
        self.use(self.exchanged(self.here))
        # Last: the search's own result does not depend on `start`.
        if self.start is not None:
            self.use(self.start)
        self.report()
        patience = FIRST_NODES
        while self.open():
            improved = self.round(patience) if self.trees else self.listed_round()
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
            # Last: the search's own result does not depend on `start`.
            if self.start is not None:
                self.use(self.start)
            if not self.open():
                return
            shares = Shares(self.budget, patience, self.clock("branch and bound"))
            # e(x) = eps_x pays for every plan of x (see the module), and asks for one tree at a time; `payment` asks
            # for all of them at once.
            short, policy = proved(
                self.world, self.policy, self.value, side, self.slack, shares.run
            )
            self.pay(short)
            better = self.use(policy)
            self.report()
            # All trees were searched to their ends and hold no better plan: more nodes would change nothing.
            if shares.closed and not better:
                return
            patience *= 2

    def improve_regions(self, side: int) -> None:
        """Rounds of ascent and exchange, until one closes little of the gap left before the first."""
        gap = gained = float((self.bound - self.value).mean())
        while gained > WORTH_A_ROUND * gap and self.open():
            before, passed = float(self.value.mean()), self.clock("policy iteration")
            self.use(improved(self.world, self.policy, self.value, side, passed))
            gained = float(self.value.mean()) - before
            self.report()

    def clock(self, stage: str) -> Callable[[float], bool]:
        """A function of the share of a round that is done: it reports the time left, and returns whether to go on."""
        began = time.monotonic()

        def passed(share: float) -> bool:
            if share:
                self.report(stage, (time.monotonic() - began) * (1.0 / share - 1.0))
            return self.budget.left()

        return passed

    def restart(self) -> bool:
        """Search from other starts; whether that gave a better policy, to be used next."""
        others = other_starts(self.renewal, RESTARTS)
        table = best_of(self.here, others, go_on=self.budget.left).table
        better = bool(self.valued(table, self.value).starts.sum() > self.value.sum())
        self.other = table if better else None
        return better

    @property
    def problem(self) -> InnerProblem:
        """The search from each located cell, over the policy at hand."""
        return InnerProblem.of(self.renewal, self.value)

    def round(self, patience: int) -> bool:
        """Search the renewals of the policy at hand; whether a better policy was found."""

        def run(tree: Tree) -> None:
            self.budget.run(tree, lambda tree: tree.nodes < patience)

        tree = planted(self.problem, self.value, self.slack, run)
        try:
            self.explore(tree, patience)
        finally:  # results and proofs so far are kept also when the user interrupts
            self.tighten(tree)
            improved = self.adopt(tree)
            # only here: until then the tree's bounds are those over the policy it was grown from
            if self.other is not None:
                improved = self.use(self.other) or improved
                self.other = None
        return improved

    def listed_round(self) -> bool:
        """As `round`, by a list of all plans."""

        def looked_at(plans: int) -> bool:
            self.budget.spent += plans
            return self.budget.left()

        renewal, world, here = self.renewal, self.world, self.here
        plans = renewal.problem(here.value)
        detected = world.reward + self.value
        one_more = revealed(world, detected, forced_worth(world, detected), 1)
        states = renewal.free[-2].states if world.t_max else renewal.states[: world.num_states]
        listed = best_plans(plans, here.sets, self.slack, one_more[states], looked_at)
        if listed is None:
            return False
        # e(x) = eps_x pays for every plan of x (see the module).
        most, sets = listed
        self.pay(np.maximum(most - self.value, 0.0))
        return self.use(renewal.table(sets))

    def adopt(self, tree: Tree) -> bool:
        """Use the better plans that the tree has found; whether the policy is better with them."""
        sets = adopted(self.problem, self.renewal.sets(self.policy), tree)
        return sets is not None and self.use(self.exchanged(Found(self.renewal, sets)))

    def exchanged(self, policy: Found) -> PolicyTable:
        """The result of exchange from `policy`."""
        return exchanged(policy, go_on=self.budget.left).table

    def explore(self, tree: Tree, patience: int) -> None:
        """Run the tree until it is closed or the budget is spent.

        Every `patience` nodes it also ends if the improvements found close a good part of the bracket: the next round
        starts from a better policy, but has to rule out again most of the plans that this tree has ruled out.
        """
        # Nodes, not seconds, also between two reports: `tighten` takes the least of the bounds at these reports.
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
        """Use the tree's bounds so far, for any V, also one off by its error."""
        self.pay(payment(tree, self.value))

    def pay(self, paid: Array) -> None:
        """Use a proof that `paid` `[M]`, the e of the module's text, pays for every plan over the policy at hand."""
        # The clocked bound and all that earlier rounds proved hold as well: the least of them is kept, cell by cell.
        more = self.paths.solve(paid)
        more = more + self.paths.error(paid, more, self.longest)
        self.bound = np.minimum(self.bound, self.value + more)

    def solution(self, interrupted: bool) -> Solution:
        if self.start is not None and not self.certified:  # the search may have ended before it
            self.use(self.start)
        return Solution(
            self.policy,
            self.evaluation,
            of_cells(self.world, np.maximum(self.bound, self.value)),
            self.certified,
            time.monotonic() - self.budget.started,
            self.budget.spent,
            interrupted,
            self.budget.timed_out and not self.certified,
        )


def plan_without_proof(world: World, starts: int) -> PolicyTable:
    """A good policy without a proof: as of `exchange.solve`, on a large grid region by region, in bounded memory."""
    if world.num_cells <= DIRECT_CELLS or not has_trees(world):
        return exchange.solve(world, starts)
    return settled(world, clocked_policy(world), widest_side(world), _ROUNDS)


def has_trees(world: World) -> bool:
    """Whether the tree, which decides on one cell at a time, can search the plans of a world."""
    return world.coverage is None and world.modes == 1 and world.budget is None


def payment(tree: Tree, value: Array) -> Array:
    """`[M]` e >= 0 with e(x) + sum_t z_t e >= eps_nu for each plan nu of x, also of a tree searched in part."""
    # `rate` falls where e rises. rate(0) will do, and with e also rate(rate(e)) <= e: from e >= rate(e) follows
    # rate(e) <= rate(rate(e)), and from that rate(rate(rate(e))) <= rate(rate(e)).
    paid = np.maximum(tree.rate(value, np.zeros_like(value)), 0.0)
    for _ in range(2):
        least = np.maximum(tree.rate(value, paid), 0.0)
        paid = np.maximum(tree.rate(value, least), 0.0)
    return paid
