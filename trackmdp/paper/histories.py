"""The Track-MDP solved over its histories, without any belief, for a few cells and sensors that never miss.

A state is (x, h): the last located cell and the sets sensed since. Its moves are summed over the single paths of the
target, so that a belief filter has no part in V and Q: Lemma 1 and Theorem 3, which equate Q and a belief, are then
about two computations that share nothing but the world.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from trackmdp.arrays.types import Array, BoolArray
from trackmdp.policies.belief import BeliefFilter
from trackmdp.solvers.pomdp import solve_states
from trackmdp.world.model import World

State: TypeAlias = tuple[int, tuple[int, ...]]
"""Last located cell, and the sets sensed since, each as its row in `actions`."""


@dataclass(frozen=True)
class HistoryQ:
    """The optimum over the histories that can happen.

    Attributes:
        world: the problem.
        actions: `[2^M, M]` all sets of sensors, the first cell being the highest bit of a set's number.
        value: V of each state.
        q: `[2^M]` Q of every action; none in a state in which the safe action is forced.
        now: `[M]` probability of each cell, given the history.
        inside: probability that the target is in the grid after the next move.
    """

    world: World
    actions: BoolArray
    value: dict[State, float]
    q: dict[State, Array]
    now: dict[State, Array]
    inside: dict[State, float]

    def without(self, cell: int) -> int:
        """The number of the set of all sensors but the one in `cell`."""
        return len(self.actions) - 1 - self.bit(cell)

    def bit(self, cell: int) -> int:
        """The number of the set of one cell."""
        return 1 << (self.world.num_cells - 1 - cell)


def solve_histories(world: World) -> HistoryQ:
    """Policy iteration over all histories that can happen, with 2^M actions in each."""
    m, kernel = world.num_cells, world.kernel.toarray()
    actions = np.array(list(itertools.product([False, True], repeat=m)))
    starts: list[State] = [(x, ()) for x in range(m)]
    now, inside = dict[State, Array](), dict[State, float]()

    def choices(state: State) -> Iterator[tuple[float, dict[State, float]]]:
        x, history = state
        now[state] = _position(kernel, x, [actions[number] for number in history])
        reach = now[state] @ kernel
        inside[state] = float(reach.sum())
        # n = t_max + 1: the safe action locates the target, at price D, if it is still in the grid.
        if len(history) == world.num_choices:
            earned = (world.reward - world.safe_cost) * reach.sum()
            yield earned, dict(zip(starts, reach.tolist(), strict=True))
            return
        for number, action in enumerate(actions):
            found, missed = reach * action, float(reach[~action].sum())
            after = dict(zip(starts, found.tolist(), strict=True))
            if missed > 0:
                after[x, (*history, number)] = missed
            # eq. reward_func: nothing is paid on the exit step, hence times the probability of staying.
            price = float(world.cost[action].sum()) * reach.sum()
            yield world.reward * found.sum() - price, after

    value, worth = solve_states(starts, choices)
    q = {state: each for state, each in worth.items() if len(state[1]) < world.num_choices}
    return HistoryQ(world, actions, value, q, now, inside)


def _position(kernel: Array, x: int, sets: list[BoolArray]) -> Array:
    """`[M]` probability of each cell of a target that left `x` and that no set has seen, path by path."""
    weight = np.zeros(len(kernel))
    for path in itertools.product(range(len(kernel)), repeat=len(sets)):
        if not any(sensed[cell] for sensed, cell in zip(sets, path, strict=True)):
            before = (x, *path)
            weight[before[-1]] += np.prod([kernel[a, b] for a, b in itertools.pairwise(before)])
    return weight / weight.sum()


def estimates(solved: HistoryQ, state: State) -> dict[int, float]:
    """Cell -> its probability from Q alone, for the cells at which a miss leaves a possible history.

    With every sensor on but the one at j, a miss means that the target is at j. So
    Q(s, all) - Q(s, all but j) = p(j) (r + V(j) - V(x, {h, all but j})) - c_j p_in.
    """
    x, history = state
    found = {}
    for j in range(solved.world.num_cells):
        after = solved.value.get((x, (*history, solved.without(j))))
        if after is not None:
            paid = solved.world.cost[j] * solved.inside[state]
            worth = solved.world.reward + solved.value[j, ()] - after
            found[j] = (advantage(solved, state, j) + paid) / worth
    return found


def advantage(solved: HistoryQ, state: State, j: int) -> float:
    """Q(s, all) - Q(s, all but j)."""
    q = solved.q[state]
    return float(q[-1] - q[solved.without(j)])


def filtered(solved: HistoryQ, state: State) -> Array:
    """`[M]` the belief filter's prediction of the next cell."""
    x, history = state
    exact = BeliefFilter(solved.world.kernel)
    predicted = exact.predict(exact.detect(np.array([x])))
    for number in history:
        predicted = exact.predict(exact.miss(predicted, solved.actions[number][None]))
    return predicted[0]


def miss_losses(solved: HistoryQ) -> Iterator[tuple[float, float]]:
    """The excess in both inequalities of Lemma 1, for every history with a miss and every cell b it leaves possible.

    W(b) is the worth of going on as V does while the target is at b. First (eq. vis_p1): W(b) - V(b, 0, {}). Second
    (eq. vis_pr2): V(x, h) less the share of b, less V of the history with b added to its last set, both times the
    probability of the rest; -inf where nothing is left.
    """
    for (x, history), now in solved.now.items():
        if not history:
            continue
        going_on = _going_on(solved, (x, history))
        for b in np.flatnonzero(now).tolist():
            first = going_on[b] - solved.value[b, ()]
            with_b = (x, (*history[:-1], history[-1] | solved.bit(b)))
            second = -np.inf
            if with_b in solved.value:
                rest = solved.value[x, history] - now[b] * going_on[b]
                second = rest - (1.0 - now[b]) * solved.value[with_b]
            yield float(first), float(second)


def _going_on(solved: HistoryQ, state: State) -> Array:
    """`[M]` W: worth of the best plan of a state, the target being in each cell."""
    world, (x, history) = solved.world, state
    kernel = world.kernel.toarray()
    located = world.reward + np.array([solved.value[j, ()] for j in range(world.num_cells)])
    if state not in solved.q:
        return kernel @ located - world.safe_cost * kernel.sum(axis=1)
    number = int(solved.q[state].argmax())
    action, after = solved.actions[number], (x, (*history, number))
    # A history that cannot happen is not listed; its weight below is 0.
    missed = _going_on(solved, after) if after in solved.value else np.zeros(world.num_cells)
    paid = float(world.cost[action].sum()) * kernel.sum(axis=1)
    return kernel @ np.where(action, located, missed) - paid
