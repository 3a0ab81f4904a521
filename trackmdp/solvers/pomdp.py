"""The POMDP of Section IV solved as one, over belief states (beta, n): a check on all that is built on plans of sets.

Every belief that some sequence of actions can lead to is listed, and the finite MDP over them is solved by policy
iteration. Beliefs multiply with the actions tried, so this is for worlds of a few cells.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field

import numpy as np
from scipy import sparse

from trackmdp.arrays.types import Array, BoolArray
from trackmdp.errors import UserError
from trackmdp.solvers.linear import accumulate
from trackmdp.world.model import World

DIGITS = 12
"""Beliefs that agree to this many digits are one."""


@dataclass(frozen=True)
class BeliefSolution:
    """The optimum over belief states.

    Attributes:
        value: `[M]`, V*_POMDP((e_b, 0)).
        beliefs: number of belief states (beta, n) that can be reached.
    """

    value: Array
    beliefs: int


@dataclass
class FiniteMdp:
    """One row per state and admissible action, the rows of a state together; `state[i]` is the state of row i."""

    state: list[int] = field(default_factory=list)
    reward: list[float] = field(default_factory=list)
    successors: list[tuple[list[int], list[float]]] = field(default_factory=list)

    def add(
        self, state: int, reward: float, successors: list[int], probability: list[float]
    ) -> None:
        """Append an action of `state`, which has to be the last state or the one after it."""
        self.state.append(state)
        self.reward.append(reward)
        self.successors.append((successors, probability))

    def solve(self, states: int) -> tuple[Array, Array]:
        """Policy iteration: the optimal value `[states]`, and the worth of each row."""
        columns = [column for successors, _ in self.successors for column in successors]
        data = [p for _, probability in self.successors for p in probability]
        pointer = np.concatenate(
            [[0], np.cumsum([len(successors) for successors, _ in self.successors])]
        )
        moves = sparse.csr_array((data, columns, pointer), shape=(len(self.state), states))
        reward, state = np.array(self.reward), np.array(self.state)
        # Rows of states 0 0 0 1 1 2 give first = (0, 3, 5), the segments that reduceat takes the maximum over.
        first = np.flatnonzero(np.diff(state, prepend=-1))
        choice, value = first, accumulate(moves[first], reward[first])
        while True:
            worth = reward + moves @ value
            best = np.maximum.reduceat(worth, first)
            better = best > worth[choice] + 1e-12 * (1.0 + np.abs(value).max())
            if not better.any():
                return value, worth
            attained = np.flatnonzero(
                worth >= best[state]
            )  # of each state the first row that does counts
            choice = np.where(better, attained[np.searchsorted(attained, first)], choice)
            value = accumulate(moves[choice], reward[choice])


def solve(world: World, *, most_beliefs: int = 50_000) -> BeliefSolution:
    """Policy iteration over all reachable belief states.

    Raises:
        UserError: there are more than `most_beliefs` of them.
    """
    problem, count = _enumerate(world, most_beliefs)
    return BeliefSolution(problem.solve(count)[0][: world.num_cells], count)


def _enumerate(world: World, most_beliefs: int) -> tuple[FiniteMdp, int]:
    kernel = world.kernel.toarray()  # a few cells: every set of sensors is tried in every belief
    forced, price = _safe_action(world, kernel)
    beliefs = [(belief, 0) for belief in np.eye(world.num_cells)]
    index = {_key(belief, n): i for i, (belief, n) in enumerate(beliefs)}
    problem = FiniteMdp()
    for i, (belief, n) in enumerate(beliefs):  # grows while it is gone through
        predicted = belief @ kernel
        # After t_max + 1 misses the safe action is forced: one action, and every position is located.
        if n == world.num_choices:
            located = belief @ forced
            problem.add(
                i, world.reward * float(located.sum()) - float(belief @ price), *_sparse(located)
            )
            continue
        for action in _subsets(predicted > 0):
            found = np.where(action, predicted * world.detection, 0.0)
            left = predicted - found
            missed = float(left.sum())  # probability of no detection and no exit
            targets, probability = _sparse(found)
            if missed > 0:
                after = left / missed  # eq. belief_up
                key = _key(after, n + 1)
                if key not in index:
                    index[key] = len(beliefs)
                    beliefs.append((after, n + 1))
                targets, probability = [*targets, index[key]], [*probability, missed]
            paid = float(world.cost[action].sum() * predicted.sum())
            problem.add(i, world.reward * float(found.sum()) - paid, targets, probability)
        if len(beliefs) > most_beliefs:
            raise UserError(
                f"grid.size={world.rows}: more than {most_beliefs} belief states, expected a smaller world"
            )
    return problem, len(beliefs)


def _subsets(possible: BoolArray) -> BoolArray:
    """Every set of possible cells, the fullest first; to sense an impossible one as well only costs."""
    cells = np.flatnonzero(possible)
    sets = np.zeros((2 ** len(cells), len(possible)), dtype=bool)
    sets[:, cells] = list(itertools.product([True, False], repeat=len(cells)))
    return sets


def _safe_action(world: World, kernel: Array) -> tuple[Array, Array]:
    """`[M, M]` by its cell, where the safe action locates the target in the end, and `[M]` the cost until then.

    Repeated until it locates: with L = P (1 - p_s), the sum of all L^k is (I - L)^-1.
    """
    repeated = np.linalg.inv(np.eye(world.num_cells) - kernel * (1.0 - world.safe_detection))
    price: Array = world.safe_cost * (repeated @ kernel.sum(axis=1))
    return repeated @ (kernel * world.safe_detection), price


def _sparse(vector: Array) -> tuple[list[int], list[float]]:
    cells = np.flatnonzero(vector)
    return cells.tolist(), vector[cells].tolist()


def _key(belief: Array, n: int) -> tuple[int, bytes]:
    # + 0.0 turns -0.0 into 0.0: their bytes differ.
    return n, (belief.round(DIGITS) + 0.0).tobytes()
