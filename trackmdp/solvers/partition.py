"""Sub-grids with a hand-off: square blocks of a large grid plan or learn alone, and the whole is valued at the end.

Each block sees its own cells and a halo of some cells around them; all farther cells are the exit. It owns only the
plans of its own cells: the owner of the cell of the last detection decides, also about sensors beyond its border. There
is no other hand-off.

From a located cell the target comes at most R (t_max + 2) cells far before it is located again, R being the reach of a
move, so that with a halo as wide a block knows all that its plans depend on but the worth of the places where the
target is located next. An error of that worth that is the same in all of them changes no decision: only where two
places are off by different amounts do plans differ, and that difference fades with each renewal
(theory.md#regions-and-blocks). The remaining loss is proved, not guessed: policy and bound are for the whole grid.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from typing import TypeAlias

import numpy as np
from scipy import sparse

from trackmdp.arrays.entries import distinct, ones_at, row_index
from trackmdp.arrays.types import BoolArray, IndexArray
from trackmdp.config.by_blocks import PartitionConfig
from trackmdp.errors import UserError
from trackmdp.grid.displacements import apart, cell_at
from trackmdp.policies.table import PolicyTable
from trackmdp.solvers.evaluation import Evaluation
from trackmdp.solvers.workers import Crew, Made, in_turn
from trackmdp.world.model import World

Planner: TypeAlias = "Callable[[int, World], PolicyTable]"
"""From a block's number and its world to its policy, by planning or by learning."""
Rectangle: TypeAlias = tuple[range, range]
"""Rows and columns of the grid."""

Pairs: TypeAlias = tuple[IndexArray, IndexArray]
"""Keys and sensors, a pair for each sensor that is on."""
_JOBS = 64
"""Jobs that the blocks of a grid are put into: a worker that dies loses one, and each costs a message."""


@dataclass(frozen=True)
class Block:
    """A block's `own` cells, and all that it sees: those and its halo, cut off at the border of the grid."""

    own: Rectangle
    seen: Rectangle

    @property
    def mine(self) -> BoolArray:
        """`[L]`, which of the cells seen are its own."""
        row, column = (
            np.isin(np.array(seen), np.array(own))
            for seen, own in zip(self.seen, self.own, strict=True)
        )
        return (row[:, None] & column).ravel()


_Planned: TypeAlias = tuple[int, World, Block, IndexArray]
"""Number of a block, its world, itself, and the numbers of its sensors on the whole grid."""


def reach(world: World) -> int:
    """R, the most rows or columns that a move can lead away."""
    cell, moves = world.motion.cell, world.kernel
    return int(apart(world.columns, cell[row_index(moves)], cell[moves.indices]).max(initial=0))


def default_halo(world: World) -> int:
    """R (t_max + 2), how far away the target can be located next: t_max + 1 free choices and the safe action.

    So many times as a key remembers detections before the last one, since one that cannot occur in a block has no plan.
    """
    return halo_of(world, (world.t_max + 2) * max(world.order, 1))


def halo_of(world: World, moves: int) -> int:
    """Where the target can be after some moves, and of footprints all cells by which a window lets them be chosen."""
    near = 0 if world.coverage is None else world.window or 0
    return max(reach(world) * moves, near)


def blocks(size: tuple[int, int], side: int, halo: int) -> list[Block]:
    """The blocks of a grid, row by row; those at its end may be smaller.

    Of 10 x 10 cells with side 4 and halo 2, the second block owns columns 4 to 7 of rows 0 to 3 and sees columns 2 to 9
    of rows 0 to 5.
    """
    cuts = [[*range(0, length, side), length] for length in size]

    def widened(begin: int, end: int, length: int) -> range:
        return range(max(begin - halo, 0), min(end + halo, length))

    return [
        Block(
            (range(*rows), range(*columns)), (widened(*rows, size[0]), widened(*columns, size[1]))
        )
        for rows, columns in product(pairwise(cuts[0]), pairwise(cuts[1]))
    ]


def sensing_blocks(world: World, side: int, halo: int) -> list[Block]:
    """The `blocks` of a grid that see a sensor: in others there is nothing to plan."""
    parts = blocks(world.size, side, halo)
    return [part for part in parts if world.available[sensors_of(world, part.seen)].any()]


def sensors_of(world: World, seen: Rectangle) -> IndexArray:
    """Numbers of the sensors that cover a cell of a rectangle, in order."""
    cells = cells_of(seen, world.columns)
    return cells if world.coverage is None else distinct(world.coverage.by_cell[cells].indices)


def sub_world(world: World, seen: Rectangle) -> World:
    """The world inside a rectangle of the grid; a target that leaves it has exited.

    Sensors are numbered as in `sensors_of`, and of their footprints the part in the rectangle is left.
    """
    rows, columns = seen
    cells, sensors = cells_of(seen, world.columns), sensors_of(world, seen)
    kernel = within(world.kernel[numbered(cells, world.modes)], world, seen, world.modes)
    own = {name: getattr(world, name)[cells] for name in ("detection", "safe_detection")}
    own |= {"cost": world.cost[sensors]}
    if world.coverage is not None:
        own |= {"coverage": within(world.coverage.matrix[sensors], world, seen)}
    # Its corner is another one.
    own |= {"size": (len(rows), len(columns)), "modes": world.modes, "place": None}
    return World.of(world, kernel, **own)


def sets_within(
    sets: sparse.csr_array, world: World, seen: Rectangle, part: World
) -> sparse.csr_array:
    """`[K, S']`, of sets `[K, S]` the sensors that can be chosen in the world `part` of a rectangle, in its numbers."""
    if world.coverage is None:
        return within(sets, world, seen)
    found = sets[:, sensors_of(world, seen)]
    # At the edge of the halo a window may let a sensor be chosen by a cell beyond it.
    row = row_index(found)
    chosen = part.choosable(row // part.num_choices, found.indices)
    return found if chosen is None else ones_at(row[chosen], found.indices[chosen], found.shape)


def within(
    matrix: sparse.csr_array, world: World, seen: Rectangle, each: int = 1
) -> sparse.csr_array:
    """`[K, L]`, of a matrix `[K, M]` the columns of the L cells of a rectangle, numbered as in it.

    Where there are `each` columns for a cell, such as those of its modes, L and M are so many times larger.
    """
    rows, columns = seen
    every, mode = np.divmod(matrix.indices, each)
    # Not by matrix[:, cells], which takes M steps for each block. With 10 columns, cell 57 is (5, 7): in the rectangle
    # of rows 4 to 8 and columns 6 to 8 it is (1, 1), number 1 * 3 + 1 = 4.
    row, column = np.divmod(every, world.columns)
    row, column = row - rows.start, column - columns.start
    cell, inside = cell_at((len(rows), len(columns)), row, column)
    place = (row_index(matrix)[inside], cell[inside] * each + mode[inside])
    shape = (matrix.shape[0], len(rows) * len(columns) * each)
    return type(matrix)((matrix.data[inside], place), shape=shape)


def plan_by_blocks(
    world: World, plan: Planner, block: int, halo: int | None = None, run: Crew = in_turn
) -> PolicyTable:
    """The policy put together from the plans of all blocks; the same bits however many workers there are.

    Args:
        world: the whole grid.
        plan: finds the deterministic policy of a block, independent of the clock; pickled where there are workers.
        block: side of the blocks.
        halo: cells around its own that a block knows of; None: `default_halo`.
        run: runs the plans of the blocks.

    Raises:
        UserError: a policy that draws was planned.
    """
    parts = sensing_blocks(world, block, default_halo(world) if halo is None else halo)
    ends = np.linspace(0, len(parts), min(_JOBS, len(parts)) + 1).astype(int)

    def some(job: int) -> list[_Planned]:
        # with their worlds: no worker needs the rest of the grid
        return [
            (n, sub_world(world, part.seen), part, sensors_of(world, part.seen))
            for n, part in enumerate(parts[ends[job] : ends[job + 1]], ends[job])
        ]

    done = run(_PlanJob(plan, world.columns), Made(len(ends) - 1, some))
    return PolicyTable.from_sensed(world, end_to_end(done))


def narrow_halo(
    world: World, partition: PartitionConfig, upper: float, found: Evaluation
) -> str | None:
    """Warning for a halo that may lose something, with the most it can have lost; None if it is wide enough."""
    wide = default_halo(world)
    if partition.block is None or partition.halo is None or partition.halo >= wide:
        return None
    lost = max(upper - found.aihtr + found.error, 0.0) / found.expected_length
    return (
        f"partition.halo={partition.halo}: below {wide}, so blocks do not see all that they decide on; "
        f"at most {lost:.4f} per step is lost"
    )


@dataclass(frozen=True)
class _PlanJob:
    """Plans some blocks: for each n the (keys, sensors) of the whole grid, of their own cells alone."""

    plan: Planner
    columns: int

    def __call__(self, job: Sequence[_Planned]) -> list[Pairs]:
        return end_to_end([self._block(*each) for each in job])

    def _block(self, number: int, world: World, block: Block, sensors: IndexArray) -> list[Pairs]:
        table = self.plan(number, world)
        table.check_fits(world)
        if not table.deterministic:
            raise UserError("partition.block: expected a policy that does not draw")
        sets = table.written
        # Row 7 of a table with two choices is key 3 after one miss.
        key, n = np.divmod(row_index(sets), world.num_choices)
        classes = table.task.keys.num_classes
        kept = block.mine[key // classes]
        keys = numbered(cells_of(block.seen, self.columns), classes)
        on = (np.flatnonzero(kept & (n == each)) for each in range(world.num_choices))
        return [(keys[key[each]], sensors[sets.indices[each]]) for each in on]


def end_to_end(parts: Sequence[Sequence[Pairs]]) -> list[Pairs]:
    """The sensed pairs of several parts at each n, end to end."""
    return [
        (
            np.concatenate([cells for cells, _ in step]),
            np.concatenate([sensors for _, sensors in step]),
        )
        for step in zip(*parts, strict=True)
    ]


def numbered(cells: IndexArray, each: int) -> IndexArray:
    """`[L · each]`, numbers of the states or keys of L cells, `each` of a cell: of cell 3 with two, 6 and 7."""
    return (cells[:, None] * each + np.arange(each)).ravel()


def cells_of(part: Rectangle, columns: int) -> IndexArray:
    """Numbers of the cells of a rectangle, row by row, on a grid of so many columns."""
    return (np.array(part[0])[:, None] * columns + np.array(part[1])).ravel()
