"""The POMDP of Section IV solved as one, over belief states (beta, n): a check on all that is built on plans of sets.

Every belief that some sequence of actions can lead to is listed, and the finite MDP over them is solved by policy
iteration. Beliefs multiply with the actions tried, so this is for worlds of a few cells.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeAlias, TypeVar

import numpy as np
from scipy import sparse

from trackmdp.arrays.types import Array, BoolArray, IndexArray
from trackmdp.errors import UserError
from trackmdp.solvers.linear import accumulate
from trackmdp.world.model import World

DIGITS = 12
"""Beliefs that agree to this many digits are one."""

State = TypeVar("State", bound=Hashable)
_Key: TypeAlias = tuple[int, bytes]
"""n, and the bytes of a belief."""


@dataclass(frozen=True)
class BeliefSolution:
    """The optimum over belief states.

    Attributes:
        value: `[M]`, V*_POMDP((e_b, 0)).
        beliefs: number of belief states (beta, n) that can be reached.
    """

    value: Array
    beliefs: int


@dataclass(frozen=True)
class Chain(Generic[State]):
    """All states that choices lead to, and their choices.

    Attributes:
        states: the starts, and then the others.
        owner: `[C]`, place of the state of each choice.
        totals: `[C]` or `[C, K]`, expected reward, or figures, of each choice.
        moves: `[C, states]`, probability of each state after it.
    """

    states: list[State]
    owner: IndexArray
    totals: Array
    moves: sparse.csr_array


def reached(
    starts: Iterable[State],
    choices: Callable[[State], Iterable[tuple[Any, dict[State, float]]]],
    most: float = math.inf,
) -> Chain[State] | None:
    """The states reached from `starts`; None where there are more than `most`.

    Of a state, `choices` gives the totals of each choice and the probabilities of the next states.
    """
    states = list(starts)
    index = {state: place for place, state in enumerate(states)}
    owner, totals, pointer = list[int](), list[Any](), [0]
    columns, data = list[int](), list[float]()
    for place, state in enumerate(states):  # grows while it is gone through
        for earned, after in choices(state):
            for each in after:
                if each not in index:
                    index[each] = len(states)
                    states.append(each)
            columns += [index[each] for each in after]
            data += after.values()
            owner.append(place)
            totals.append(earned)
            pointer.append(len(data))
        if len(states) > most:
            return None
    moves = sparse.csr_array((data, columns, pointer), shape=(len(owner), len(states)))
    return Chain(states, np.array(owner), np.array(totals), moves)


def solve_states(
    starts: Sequence[State], choices: Callable[[State], Iterable[tuple[float, dict[State, float]]]]
) -> tuple[dict[State, float], dict[State, Array]]:
    """Policy iteration over all states `reached`: the optimal value of each, and the worth of its choices."""
    chain = reached(starts, choices)
    assert chain is not None  # any number may be
    states, owner, reward, moves = chain.states, chain.owner, chain.totals, chain.moves
    # States with 3, 2 and 1 choices have first = (0, 3, 5), the segments that reduceat takes the maximum over.
    first = np.flatnonzero(np.diff(owner, prepend=-1))
    choice, value = first, accumulate(moves[first], reward[first])
    while True:
        worth = reward + moves @ value
        best = np.maximum.reduceat(worth, first)
        # By more than rounding, of the numbers that a choice leads to: beside a large D no gain would count elsewhere.
        better = best > (worth + 1e-12 * (1.0 + np.abs(reward) + moves @ np.abs(value)))[choice]
        if not better.any():
            break
        attained = np.flatnonzero(worth >= best[owner])  # of each state the first one counts
        choice = np.where(better, attained[np.searchsorted(attained, first)], choice)
        value = accumulate(moves[choice], reward[choice])
    worths = np.split(worth, first[1:])
    return dict(zip(states, value.tolist(), strict=True)), dict(zip(states, worths, strict=True))


def solve(world: World, *, most_beliefs: int = 50_000) -> BeliefSolution:
    """Policy iteration over all reachable belief states.

    Raises:
        UserError: there are more than `most_beliefs` of them.
    """
    kernel = world.kernel.toarray()  # a few cells: every set of sensors is tried in every belief
    forced, price = _safe_action(world, kernel)
    beliefs = {_key(belief, 0): belief for belief in np.eye(world.num_cells)}
    starts = list(beliefs)

    def choices(state: _Key) -> Iterator[tuple[float, dict[_Key, float]]]:
        if len(beliefs) > most_beliefs:
            raise UserError(
                f"grid.size={world.rows}: more than {most_beliefs} belief states, expected a smaller world"
            )
        n, belief = state[0], beliefs[state]
        # After t_max + 1 misses the safe action is forced: one action, and every position is located.
        if n == world.num_choices:
            located = belief @ forced
            earned = world.reward * float(located.sum()) - float(belief @ price)
            yield earned, {starts[j]: float(located[j]) for j in np.flatnonzero(located)}
            return
        predicted = belief @ kernel
        for action in _subsets(predicted > 0):
            found = np.where(action, predicted * world.detection, 0.0)
            after = {starts[j]: float(found[j]) for j in np.flatnonzero(found)}
            left = predicted - found
            missed = float(left.sum())  # probability of no detection and no exit
            if missed > 0:
                key = _key(left / missed, n + 1)
                beliefs.setdefault(key, left / missed)  # eq. belief_up
                after[key] = missed
            paid = float(world.cost[action].sum() * predicted.sum())
            yield world.reward * float(found.sum()) - paid, after

    value, _ = solve_states(starts, choices)
    return BeliefSolution(np.array([value[start] for start in starts]), len(value))


def _subsets(possible: BoolArray) -> BoolArray:
    """Every set of possible cells, the fullest first; to sense an impossible one as well only costs."""
    cells = np.flatnonzero(possible)
    sets = np.zeros((2 ** len(cells), len(possible)), bool)
    sets[:, cells] = list(itertools.product([True, False], repeat=len(cells)))
    return sets


def _safe_action(world: World, kernel: Array) -> tuple[Array, Array]:
    """`[M, M]` by its cell, where the safe action locates the target in the end, and `[M]` the cost until then.

    Repeated until it locates: with L = P (1 - p_s), the sum of all L^k is (I - L)^-1.
    """
    repeated = np.linalg.inv(np.eye(world.num_cells) - kernel * (1.0 - world.safe_detection))
    price: Array = world.safe_cost * (repeated @ kernel.sum(axis=1))
    return repeated @ (kernel * world.safe_detection), price


def _key(belief: Array, n: int) -> _Key:
    # + 0.0 turns -0.0 into 0.0: their bytes differ.
    return n, (belief.round(DIGITS) + 0.0).tobytes()
