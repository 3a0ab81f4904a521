"""One round of policy iteration on a large grid, region by region, with the memory that one region takes.

The value V of being located given, the best plan of each located cell is a problem of its own, about the cells within
t_max + 1 moves. So a region, a square block of located cells with a halo of R (t_max + 1) cells, has all that its plans
depend on: V and the worth of the safe action come from the whole grid, and nothing is lost at its border, unlike where
blocks plan without knowing V (`partition`). Plans of all regions together, each worth no less than before, make a
policy of no less value anywhere, and the bounds of the plans bound the whole (`optimal`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from scipy import sparse

from trackmdp.arrays.types import Array, BoolArray, IndexArray
from trackmdp.config.sensors import LARGEST_PRICE
from trackmdp.errors import UserError
from trackmdp.machine import free_bytes, gib, parse_bytes
from trackmdp.policies.table import PolicyTable
from trackmdp.solvers import rules
from trackmdp.solvers.certify.branch import Tree
from trackmdp.solvers.certify.inner import InnerProblem
from trackmdp.solvers.certify.known import adopted, planted
from trackmdp.solvers.exchange import exchange, hopeful, revealed
from trackmdp.solvers.linear import DIRECT_CELLS
from trackmdp.solvers.motion_totals import forced_worth
from trackmdp.solvers.partition import (
    Pairs,
    cells_of,
    end_to_end,
    halo_of,
    numbered,
    reach,
    sensing_blocks,
    sensors_of,
    sets_within,
    sub_world,
)
from trackmdp.solvers.renewal import Renewal
from trackmdp.solvers.value import value_of
from trackmdp.solvers.walk import Step
from trackmdp.solvers.workers import Crew, Made, in_turn
from trackmdp.world.model import World

ROOM, SMALLEST_SIDE, LARGEST_SIDE = 2**28, 32, 128
"""Bytes of a region, and its located cells in each direction, unless there is less memory. Wider ones have a smaller
share of halo, 13 % at 128 cells, R = 2 and T_max = 1; in narrow ones most of the work is for the halo."""

PATCH = 24
"""Rows and columns of the middle of the grid that the memory of the whole is estimated on."""


@dataclass(frozen=True)
class _Region:
    """The plans of the located cells of a block, cells numbered as in the rectangle that it sees.

    Attributes:
        world: the part of the world that it sees.
        cells: `[L]`, numbers of the region's cells on the whole grid.
        sensors: the same of its sensors.
        own: `[L]`, the located cells of its plans.
        policy: the one at hand.
        value: `[L]`, V.
        detected, missed: `[L]`, as of `InnerProblem`.
    """

    world: World
    cells: IndexArray
    sensors: IndexArray
    own: BoolArray
    policy: PolicyTable
    value: Array
    detected: Array
    missed: Array

    @cached_property
    def problem(self) -> InnerProblem:
        """The search from each of its cells; plans of cells of the halo are not looked at."""
        renewal = Renewal(self.world, self.world.motion)
        return InnerProblem(renewal, self.detected, self.missed, self.world.num_choices)

    @cached_property
    def sets(self) -> list[BoolArray]:
        """The sets of the policy at hand."""
        return self.problem.renewal.sets(self.policy)

    @cached_property
    def most(self) -> Array:
        """`[L]` worth of the best plans if the position were revealed after every set."""
        return revealed(self.world, self.detected, self.missed, self.world.num_choices)

    def improved(self) -> list[Pairs]:
        """The sensors on after ascent and exchange; see `sensed`."""
        plans = self.problem.plans()
        sets = plans.ascend(self.sets, sweeps=10)
        return self.sensed(exchange(plans, sets, self.own & hopeful(plans, sets, self.most)))

    def sensed(self, sets: Sequence[BoolArray]) -> list[Pairs]:
        """The sensors on at each n, of its own located cells, numbered as on the whole grid."""
        found = []
        for choice, on in zip(self.problem.renewal.choices, sets, strict=True):
            mine = on[:, 0] & self.own[choice.rows]
            found.append((self.cells[choice.rows[mine]], self.sensors[choice.sensors[mine]]))
        return found


def region_side(world: World, memory: str | None = None) -> int | None:
    """Located cells of a region in each direction; None where the grid is small enough to be searched at once.

    It does not depend on the machine: with a `memory` of its own a region is made smaller, never larger.

    Raises:
        UserError: no region is small enough for `memory`, or for the machine's free memory.
    """
    whole, limit = _whole_bytes(world), free_bytes() if memory is None else parse_bytes(memory)
    if world.num_cells <= DIRECT_CELLS and whole + _region_bytes(world, max(world.size)) <= limit:
        return None
    own = (ROOM, SMALLEST_SIDE) if memory is None else (min(ROOM, limit - whole), 1)
    side = widest_side(world, *own)
    if (needed := whole + _region_bytes(world, side)) > limit:
        said = f"{gib(limit)} are available" if memory is None else "expected at least that"
        size = f"{world.rows} x {world.columns} cells need about {gib(needed)}"
        raise UserError(f"solver.memory={memory or 'null'}: {size}, {said}")
    return side


def widest_side(world: World, room: int = ROOM, smallest: int = SMALLEST_SIDE) -> int:
    """Located cells of a region in each direction, as many as `room` bytes hold, but at least `smallest`."""
    sides = range(smallest, LARGEST_SIDE + 1)
    return max((side for side in sides if _region_bytes(world, side) <= room), default=smallest)


def _whole_bytes(world: World) -> int:
    """About the memory, Python included, for the whole grid: bounds, policies, their systems.

    The most that is held at once is the prediction of the policy that senses least, the clocked one, while it is
    made: some 200 bytes an entry, measured on 160 x 160 cells at T_max 1 to 3 and c = .16 and .22.
    """
    moves = world.kernel.nnz / world.num_cells
    return int(
        70 * 2**20 + world.num_cells * (150 * (1 + moves) + 200 * max(moves, _predicted(world)))
    )


def _predicted(world: World) -> float:
    """Where the target may be after t_max misses: entries per located cell, as they are in the middle of the grid.

    At T_max 3 these are 3 cells at c = .16, where likely cells are sensed, and 82 at c = .22, where none is.
    """
    if world.num_cells <= PATCH**2:  # too few for their memory to matter
        return 0.0
    rows, columns = (
        range(max(side - PATCH, 0) // 2, min(side + PATCH, 2 * side) // 2) for side in world.size
    )
    if not world.available[cells_of((rows, columns), world.columns)].any():
        world = world.but(cost=LARGEST_PRICE)  # nothing is sensed there
    patch, entries = sub_world(world, (rows, columns)), list[int]()
    rule = rules.clocked_rule(patch)

    def counted(step: Step, before: Array, mass: Array) -> rules.Offer:
        entries.append(len(mass))
        return rule(step, before, mass)

    rules.unroll(patch, counted)
    return max(entries) / patch.num_cells


def _region_bytes(world: World, side: int) -> int:
    """About the memory of one region of `side` x `side` located cells, its halo included."""
    halo = 2 * reach(world) * world.num_choices
    seen = min(side + halo, world.rows) * min(side + halo, world.columns)
    moves, entries, each = int(np.diff(world.kernel.indptr).max(initial=0)), 1, 0
    for step in range(1, world.num_choices + 1):
        # After t moves of up to R cells the target is within a window of 2 R t + 1 rows and columns.
        after = min(entries * moves, (halo // world.num_choices * step + 1) ** 2, world.num_cells)
        # 24 bytes for each move while a layer is made, 60 in all for each entry kept
        each, entries = each + 24 * entries * moves + 60 * after, after
    return seen * each


def _regions(world: World, policy: PolicyTable, value: Array, side: int) -> Made[_Region]:
    detected = world.reward + value
    worth = (value, detected, forced_worth(world, detected))
    parts = sensing_blocks(world, side, halo_of(world, world.num_choices))

    def region(number: int) -> _Region:
        block = parts[number]
        cells, here = cells_of(block.seen, world.columns), sub_world(world, block.seen)
        states = numbered(cells, world.num_choices)
        rows = policy.sets if policy.alike else policy.sets[states]
        mine = PolicyTable(here, sets_within(rows, world, block.seen, here))
        sensors = sensors_of(world, block.seen)
        return _Region(here, cells, sensors, block.mine, mine, *(each[cells] for each in worth))

    return Made(len(parts), region)


def improved(
    world: World, policy: PolicyTable, value: Array, side: int, passed: Callable[[float], bool]
) -> PolicyTable:
    """The policy that ascent and exchange make of `policy`, worth `value` `[M]`; worth no less anywhere.

    Args:
        world: the problem.
        policy: where to start.
        value: `[M]`, V.
        side: located cells of a region, in each direction.
        passed: called with the share of the regions done; returns whether to look further.
    """
    found, regions, go_on = [], _regions(world, policy, value, side), True
    for number, region in enumerate(regions, start=1):
        found.append(region.improved() if go_on else region.sensed(region.sets))
        go_on = go_on and passed(number / len(regions))
    return PolicyTable.from_sensed(world, end_to_end(found))


def settled(
    world: World, policy: PolicyTable, side: int, rounds: int, run: Crew = in_turn
) -> PolicyTable:
    """The policy after at most `rounds` of `improved`, each done by `run`, fewer where no value grows.

    Blocks that planned without each other's values leave plans that none of them would change: .006 per step at
    c = .22, T_max 2, blocks of 5 and a halo of 4.
    """
    value = value_of(world, policy).value
    for _ in range(rounds):
        candidate = PolicyTable.from_sensed(
            world, end_to_end(run(_Region.improved, _regions(world, policy, value, side)))
        )
        after = value_of(world, candidate, guess=value).value
        # As in `exchange`: no value is lower, so the sum decides; the margin is rounding.
        if after.sum() <= value.sum() + 1e-12 * np.abs(value).sum():
            break
        policy, value = candidate, after
    return policy


def proved(
    world: World,
    policy: PolicyTable,
    value: Array,
    side: int,
    slack: float,
    run: Callable[[int, int, Tree], None],
) -> tuple[Array, PolicyTable]:
    """Search the plans of all located cells that may not be the best by branch and bound, region by region.

    Args:
        world: the problem.
        policy: a policy.
        value: `[M]`, its value.
        side: located cells of a region, in each direction.
        slack: worth of a plan that may be missed.
        run: runs a tree as far as the budget allows, given how many regions are done, and of how many.

    Returns:
        `[M]` no less than the gain of any plan over V, and the policy with the better plans found.
    """
    short = np.full(world.num_cells, slack)
    found = []
    regions = _regions(world, policy, value, side)
    for number, region in enumerate(regions):
        sets, excess = _closed(region, slack, partial(run, number, len(regions)))
        own = region.own
        short[region.cells[own]] = np.maximum(excess[own], 0.0)
        found.append(region.sensed(sets))
    return short, PolicyTable.from_sensed(world, end_to_end(found))


def _closed(
    region: _Region, slack: float, run: Callable[[Tree], None]
) -> tuple[list[BoolArray], Array]:
    """Better plans, and `[L]` the largest possible gain over V of a plan of each own cell."""
    problem, most = region.problem, region.most - region.value
    open_ = np.flatnonzero(region.own & (most > slack))
    if not len(open_):
        return region.sets, most
    # One problem per cell, so that the window of problem x is the window around cell x; closed cells have mass 0 and
    # no better plan.
    start = np.zeros(len(region.cells))
    start[open_] = 1.0
    mass = sparse.csr_array(sparse.diags_array(start))
    mass.eliminate_zeros()
    lower = np.full(len(region.cells), np.inf)
    lower[open_] = region.value[open_]
    tree = planted(problem, lower, slack, run, mass)
    run(tree)
    most[open_] = np.minimum(most, tree.upper() - region.value)[open_]
    return adopted(problem, region.sets, tree) or region.sets, most
