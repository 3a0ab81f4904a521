"""Values and bounds from their definition, for any world and any recording: no code of the solvers.

A place (state z, history, misses n) is all that the future depends on; history is the cells of the last detections, the
misses before the last one and the mode that it revealed. Places are a Markov chain: with h steps left
V_h = b + T V_{h-1}, from V_0 = 0, until the episode is cut or nothing changes any more.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
from scipy import sparse

from trackmdp.arrays.types import Array, BoolArray
from trackmdp.policies.table import PolicyTable
from trackmdp.sensing.task import Task
from trackmdp.world.model import World
from trackmdp.world.problem import Problem

FIGURES = ("aihtr", "accuracy", "sensors_per_step", "safe_per_episode", "expected_length")
_KEPT = {"cell": 1, "displacement": 2, "displacement_gap": 2, "two_displacements": 3}
_MANY = 100_000


class History(NamedTuple):
    """Cells of the last detections, misses before the last of them, and the mode that it revealed."""

    cells: tuple[int, ...]
    gap: int
    mode: int


Place: TypeAlias = tuple[int, History, int]


class Target(NamedTuple):
    """Moves `[Z, Z]`, the cell of each state, the states of starts, whether a recording stops there, and H."""

    moves: Array
    cell: list[int]
    starts: list[int]
    stops: list[bool]
    modes: int


def target_of(problem: Problem) -> Target:
    """The states of a target: (cell, mode), or the points of the held-out tracks."""
    if isinstance(problem, World):
        states = list(range(problem.num_cells * problem.modes))
        cell = [z // problem.modes for z in states]
        return Target(problem.kernel.toarray(), cell, states, [False] * len(states), problem.modes)
    tracks = problem.held_out
    cells, stops, starts = [], [], []
    for begin, end, exits in zip(tracks.first[:-1], tracks.first[1:], tracks.exits, strict=True):
        starts.append(len(cells))
        cells += tracks.cells[begin:end].tolist()
        stops += [False] * int(end - begin - 1) + [not exits]
    moves = np.eye(len(cells), k=1)
    moves[[start - 1 for start in starts[1:]]] = 0.0
    return Target(moves, cells, starts, stops, 1)


def key_of(task: Task, history: History) -> int:
    """The number of the key, by the rules of `trackmdp.memory.keys`."""
    cells, side = history.cells, 2 * task.clip + 1

    def number(back: int, clip: int) -> int:
        rows, columns = (
            max(-clip, min(clip, after - before))
            for before, after in zip(
                divmod(cells[-back - 1], task.columns),
                divmod(cells[-back], task.columns),
                strict=True,
            )
        )
        return (rows + clip) * (2 * clip + 1) + columns + clip

    known = 0
    if task.memory != "cell" and len(cells) > 1:
        known = 1 + number(1, task.clip)
        if task.memory == "displacement_gap":
            known += history.gap * side**2
    if task.memory == "two_displacements":
        known = known * 10 + (1 + number(2, 1) if len(cells) > 2 else 0)
    return (cells[-1] * _classes(task) + known) * task.revealed + history.mode


def _classes(task: Task) -> int:
    last = (2 * task.clip + 1) ** 2
    gaps = 1 + (task.t_max + 2) * last
    counts = {"cell": 1, "displacement": 1 + last, "displacement_gap": gaps}
    return counts.get(task.memory, (1 + last) * 10)


def sees(task: Task) -> Array:
    """`[S, M]`, probability that each sensor, if it is on, reports a target in each cell."""
    covers = np.eye(task.num_cells) if task.coverage is None else task.coverage.matrix.toarray()
    return np.asarray(covers * task.detection)


def choosable(task: Task) -> BoolArray:
    """`[M, S]`, whether a sensor exists and covers a cell in the window around each located cell."""
    row, column = np.divmod(np.arange(task.num_cells), task.columns)
    apart = np.maximum(abs(row[:, None] - row), abs(column[:, None] - column))
    near = apart <= (np.inf if task.window is None else task.window)
    return ((near.astype(float) @ (sees(task) > 0).T) > 0) & ~np.isnan(task.cost)


@dataclass(frozen=True)
class Chain:
    """All places that episodes come to.

    Attributes:
        moves: `[P, P]`.
        earned: `[P, 6]` expected reward, steps in the grid, detections, sensors on, safe actions and steps of one step.
        starts: the first places.
        places: (state, history, misses) of each.
    """

    moves: sparse.csr_array
    earned: Array
    starts: list[int]
    places: list[Place]

    def totals(self, max_steps: int | None) -> Array:
        """`[F, 6]` of the episodes of each start."""
        totals = np.zeros_like(self.earned)
        for _ in range(_MANY if max_steps is None else max_steps):
            before, totals = totals, self.earned + self.moves @ totals
            if np.abs(totals - before).max() <= 1e-15 * np.abs(totals).max():
                break
        return totals[self.starts]


def chain_of(problem: Problem, policy: PolicyTable, others: Sequence[Place] = ()) -> Chain:
    """The chain of a policy with sets, with `others` as if episodes came to them; sensors are independent."""
    target, reports, price = target_of(problem), sees(problem), np.nan_to_num(problem.cost)
    table = policy.sets.toarray().astype(float)
    number: dict[Place, int] = {}
    places: list[Place] = []
    steps: list[tuple[int, int, float]] = []
    earned: list[list[float]] = []

    def place(state: int, history: History, misses: int) -> int:
        new = (state, history, misses)
        if new not in number:
            number[new] = len(places)
            places.append(new)
        return number[new]

    def located(state: int, before: tuple[int, ...], misses: int) -> int:
        cells = (*before, target.cell[state])[-_KEPT[policy.task.memory] :]
        gap = misses if policy.task.memory == "displacement_gap" and len(cells) > 1 else 0
        mode = state % target.modes if policy.task.revealed > 1 else 0
        return place(state, History(cells, gap, mode), 0)

    starts = [located(state, (), 0) for state in target.starts]
    for other in others:
        place(*other)
    while len(earned) < len(places):
        here = len(earned)
        state, history, n = places[here]
        forced = n > problem.t_max
        on = table[key_of(policy.task, history) * problem.num_choices + min(n, problem.t_max)]
        chance = 1.0 - np.prod(1.0 - on[:, None] * reports, axis=0)
        chance, paid = (
            (problem.safe_detection, problem.safe_cost) if forced else (chance, on @ price)
        )
        found, inside = 0.0, float(target.moves[state].sum())
        for after in np.flatnonzero(target.moves[state]).tolist():
            move, report = target.moves[state, after], chance[target.cell[after]]
            found += move * report
            if report > 0:
                steps.append((here, located(after, history.cells, n), move * report))
            if report < 1:
                missed = place(after, history, min(n + 1, problem.t_max + 1))
                steps.append((here, missed, move * (1.0 - report)))
        sensors, length = (0.0 if forced else on.sum()), 0.0 if target.stops[state] else 1.0
        reward = problem.reward * found - paid * inside
        earned.append([reward, inside, found, sensors * inside, forced * inside, length])
    before, later, chances = zip(*steps, strict=True) if steps else ((), (), ())
    moves = sparse.csr_array((chances, (before, later)), shape=(len(places), len(places)))
    return Chain(moves, np.array(earned), starts, places)


def totals_of(problem: Problem, policy: PolicyTable) -> Array:
    """`[F, 6]`, see `Chain`."""
    return chain_of(problem, policy).totals(problem.max_steps)


def by_cell(problem: Problem, values: Array) -> Array:
    """`[M]` means of `values` `[F]` over the starts in each cell, nan where there is none."""
    target = target_of(problem)
    cells = np.array(target.cell)[target.starts]
    return np.array(
        [
            values[cells == x].mean() if (cells == x).any() else np.nan
            for x in range(problem.num_cells)
        ]
    )


def figures_of(totals: Array) -> dict[str, float]:
    """The figures of an evaluation, pooled over all starts."""
    reward, inside, found, sensors, safe, length = totals.mean(axis=0).tolist()
    return dict(
        zip(
            FIGURES,
            (
                reward,
                found / inside if inside else 1.0,
                sensors / max(inside, 1e-300),
                safe,
                length,
            ),
            strict=True,
        )
    )


def subsets(task: Task) -> BoolArray:
    """`[2^S, S]`, all sets of the sensors that exist."""
    every = itertools.product(
        *((False, True) if here else (False,) for here in ~np.isnan(task.cost))
    )
    return np.array(list(every))


def clocked(world: World) -> Array:
    """`[M]` the bound to which the state is revealed after every step while n runs on, every set tried."""
    kernel, cell = world.kernel.toarray(), np.array(target_of(world).cell)
    inside, sets = kernel.sum(axis=1), subsets(world)
    report = 1.0 - np.prod(1.0 - sets[:, :, None] * sees(world), axis=1)[:, cell]
    paid = sets @ np.nan_to_num(world.cost)
    table, left = np.zeros((len(kernel), world.t_max + 2)), world.max_steps or _MANY
    for _ in range(left):
        before = table.copy()
        located = world.reward + before[:, :1]
        safe = world.safe_detection[cell]
        forced = kernel @ (safe * located[:, 0] + (1 - safe) * before[:, -1])
        table[:, -1] = forced - world.safe_cost * inside
        for n in range(world.num_choices):
            worth = report * (located[:, 0] - before[:, n + 1]) + before[:, n + 1]
            table[:, n] = (worth @ kernel.T - paid[:, None] * inside).max(axis=0)
        if np.abs(table - before).max() <= 1e-14 * max(1.0, np.abs(table).max()):
            break
    return table[:, 0].reshape(world.num_cells, -1).mean(axis=1)
