"""Theorem 3 from a Q that knows no belief: the Track-MDP solved over its histories, for a world of a few cells.

A state is what the policy sees: the located cell x and the sets sensed since. How it moves on is summed over the
target's single paths, so that a belief filter has no part in Q: that the estimate from Q is the belief is then a
statement about two computations that share nothing but the world.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from trackmdp.solvers.pomdp import FiniteMdp
from trackmdp.world.model import Array, BoolArray, World

History = tuple[int, ...]
"""Sets sensed since the last detection, each as its number in `actions`."""


@dataclass(frozen=True)
class HistoryQ:
    """The optimum over histories.

    Attributes:
        value: (x, history) -> V, for every history that can happen.
        q: (x, history) -> `[2^M]` Q of every action; forced states have none.
        inside: (x, history) -> probability that the target is still in the grid after the next move.
        actions: `[2^M, M]` the set that each number stands for.
    """

    value: dict[tuple[int, History], float]
    q: dict[tuple[int, History], Array]
    inside: dict[tuple[int, History], float]
    actions: BoolArray


def solve_histories(world: World) -> HistoryQ:
    """Policy iteration over all histories that can happen; 2^M actions in each."""
    m, kernel = world.num_cells, world.kernel.toarray()
    actions = np.array(list(itertools.product([False, True], repeat=m)))
    states: list[tuple[int, History]] = [(x, ()) for x in range(m)]
    index = {state: place for place, state in enumerate(states)}
    problem, inside, rows = FiniteMdp(), {}, {}
    for place, (x, history) in enumerate(states):  # grows while it is gone through
        # `[M]`, conditioned on the misses of this history; its sum is below 1 by the probability of exit.
        reach = _next_cells(kernel, x, [actions[number] for number in history])
        inside[x, history] = float(reach.sum())
        # n = t_max + 1: the safe action locates the target in any case, at price D, and only in the grid.
        if len(history) == world.num_choices:
            problem.add(place, (world.reward - world.safe_cost) * reach.sum(), list(range(m)), reach.tolist())
            continue
        rows[x, history] = len(problem.state)
        for number, action in enumerate(actions):
            found = np.where(action, reach, 0.0)
            targets, probability = list(range(m)), found.tolist()
            missed = float(reach[~action].sum())
            if missed > 0:
                after = (x, (*history, number))
                if after not in index:
                    index[after] = len(states)
                    states.append(after)
                targets, probability = [*targets, index[after]], [*probability, missed]
            # eq. reward_func: nothing is paid on the exit step, hence times the probability of still being in the
            # grid.
            price = float(world.cost[action].sum()) * reach.sum()
            problem.add(place, world.reward * found.sum() - price, targets, probability)
    value, worth = problem.solve(len(states))
    q = {state: worth[row : row + len(actions)] for state, row in rows.items()}
    return HistoryQ(dict(zip(states, value.tolist(), strict=True)), q, inside, actions)


def estimates(world: World, solved: HistoryQ, state: tuple[int, History]) -> dict[int, float]:
    """Cell -> its probability as Q tells it, for the cells whose miss leaves a history that can happen.

    With every sensor on but the one at j, a miss says that the target is at j. So
    Q(s, all) - Q(s, all but j) = p(j) (r + V(j) - V(x, {h, all but j})) - c_j p_in.
    """
    x, history = state
    found, everything = {}, len(solved.actions) - 1
    for j in range(world.num_cells):
        others = everything - (1 << (world.num_cells - 1 - j))  # `product` counts the first cell as the highest bit
        after = solved.value.get((x, (*history, others)))
        if after is not None:
            difference = float(solved.q[state][everything] - solved.q[state][others])
            worth = world.reward + solved.value[j, ()] - after
            found[j] = (difference + world.cost[j] * solved.inside[state]) / worth
    return found


def filtered(world: World, solved: HistoryQ, state: tuple[int, History]) -> Array:
    """`[M]` the belief filter's prediction at a history."""
    import torch  # only here: solving needs none

    from trackmdp.episodes.belief import BeliefFilter

    x, history = state
    filter_ = BeliefFilter(world.kernel)
    predicted = filter_.predict(filter_.detect(torch.tensor([x])))
    for number in history:
        action = torch.as_tensor(solved.actions[number])[None]
        predicted = filter_.predict(filter_.miss(predicted, action))
    return np.asarray(predicted[0].numpy())


def _next_cells(kernel: Array, x: int, sets: list[npt.NDArray[np.bool_]]) -> Array:
    """`[M]` probability of each next cell, given that the target left `x` and no set has seen it: path by path."""
    m, paths = len(kernel), np.zeros(len(kernel))
    unseen = 0.0
    for path in itertools.product(range(m), repeat=len(sets)):
        before = [x, *path]
        if any(sensed[cell] for sensed, cell in zip(sets, path, strict=True)):
            continue
        probability = float(np.prod([kernel[a, b] for a, b in itertools.pairwise(before)]))
        unseen += probability
        paths += probability * kernel[before[-1]]
    return paths / unseen
