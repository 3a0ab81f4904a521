"""Upper bounds for several targets: each pays a share of the price of a sensor (theory.md#several-targets).

If the shares of all targets come to at most 1 in every situation, no policy is charged more than it pays, and the
targets may be solved apart, each with the sensors that it likes best. For two targets the share of sensor j depends on
both positions, revealed before every step: g_1j / (g_1j + g_2j), its gains by the clocked bounds of single targets.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import sparse

from trackmdp.arrays.entries import row_index, summing, with_data
from trackmdp.arrays.types import Array
from trackmdp.sensing.task import Task
from trackmdp.solvers.bounds import clocked, clocked_table, valid
from trackmdp.solvers.motion_totals import expected_steps
from trackmdp.world.group import Group
from trackmdp.world.model import World

MOST_PAIRS = 2**16
"""Pairs of positions up to which shares depend on both: 256 cells."""
_ENOUGH = 1e-7
"""Change of a value per step at which the iteration ends; the bound allows for what is left."""


def upper_bound(group: Group) -> float:
    """Proved: no policy for the targets has a higher AIHTR; nan on recorded tracks, which have no bound."""
    if group.recorded is not None:
        return math.nan
    equal = equal_shares(group)
    task = group.task
    # Sensors are decided on one by one, as if there were no budget, and states are cells.
    apart = task.coverage is None and group.modes == 1
    if len(group) != 2 or task.num_cells**2 > MOST_PAIRS or not apart:
        return equal
    one, other = group.worlds
    first = _Paired(one, other).value
    both = first.T + first if one is other else first + _Paired(other, one).value.T
    return min(equal, float(both.mean()))


def equal_shares(group: Group) -> float:
    """The sum of the bounds of single targets that pay 1 / K of each price, the safe action's included.

    Other targets may force the safe action at any time. The clocked bound, in which the own clock alone does, holds
    where all sensors can take its place; else the valid bound does, which allows it in every step.
    """
    cost, safe = group.task.cost / len(group), group.task.safe_cost / len(group)
    bound = clocked if sensors_suffice(group.task) else valid
    values = [float(bound(world.but(cost=cost, safe_cost=safe)).mean()) for world in group.kinds]
    return sum(values[kind] for kind in group.kind)


def sensors_suffice(task: Task) -> bool:
    """Whether all sensors together do what the safe action does, are no dearer, and are allowed by the budget."""
    dear = task.safe_cost >= float(np.nansum(task.cost)) * (1.0 - 1e-12)
    everywhere = np.diff(task.sees_by_cell[:, task.available].indptr).all()
    return dear and task.perfect and bool(everywhere) and not task.limited


@dataclass(frozen=True, eq=False)
class _Paired:
    """The clocked bound of `world`'s target, the position of the one of `other` being revealed as well.

    The other target may force the safe action at any time, which also locates this one: it is allowed at every n, at
    half its price while both are in the grid.
    """

    world: World
    other: World

    @cached_property
    def shares(self) -> Array:
        """`[E, M + 1]`, share of the sensor of each entry of the kernel by the other's place, M where it has left."""
        own, cells = self.gains(self.world), self.world.kernel.indices
        mine = own.data[:, None]
        theirs = self.gains(self.other)[:, cells].toarray().T
        both = np.maximum(mine, 0.0) + np.maximum(theirs, 0.0)
        found = np.divide(np.maximum(mine, 0.0), both, out=np.full_like(both, 0.5), where=both > 0)
        return np.hstack([found, np.ones((len(cells), 1))])

    @staticmethod
    def gains(world: World) -> sparse.csr_array:
        """`[M, M]`, gain of sensing a cell from a known one, n = 0, before its price."""
        table = clocked_table(world).table
        worth = world.detection * (world.reward + table[:, 0] - table[:, 1])
        return with_data(world.kernel, world.kernel.data * worth[world.kernel.indices])

    @cached_property
    def value(self) -> Array:
        """`[M, M]`, of this target's and the other's cell at the start, both located."""
        world, last = self.world, self.world.num_choices
        table = np.zeros((world.num_cells, world.num_cells + 1, last + 1))
        most = world.max_steps
        longest = float(expected_steps(world).max()) if most is None else float(most)
        for number in itertools.count(1):
            after = self._round(table)
            # Where all values fall none of the falls is a bound on those to come; 0 is one.
            change = max(float((after - table).max()), 0.0)
            fall, size = (each.max(axis=(0, 1)) for each in (table - after, np.abs(after)))
            # beside a large D changes do not settle below rounding
            enough = _ENOUGH + 1e-14 * float(size.max())
            table = after
            # The most that all further rounds add, as every round is a step of this target in the grid.
            settled = change <= enough and bool((fall <= enough + _ENOUGH * size).all())
            if settled or number == most:
                break
        return table[:, :-1, 0] + (0.0 if number == most else change * longest)

    @cached_property
    def _stays(self) -> sparse.csr_array:
        """`[M + 1, M + 1]`, moves of the other target, the exit being a place where it stays."""
        kernel, cells = self.other.kernel, self.other.num_cells
        gone = sparse.csr_array(np.append(1.0 - self.other.stay_probability, 1.0)[:, None])
        whole = sparse.vstack([kernel, sparse.csr_array((1, cells))])
        return sparse.hstack([whole, gone])

    @cached_property
    def _prices(self) -> Array:
        """`[E, M + 1]`, expected price of each sensor."""
        world = self.world
        price = world.prices[world.kernel.indices] * world.stay_probability[row_index(world.kernel)]
        return self.shares * price[:, None]

    def _round(self, table: Array) -> Array:
        """One more step before `table` `[M, M + 1, T + 2]`."""
        world, kernel = self.world, self.world.kernel
        to, clocks = kernel.indices, table.shape[2]
        # After the other's move: `[M, M + 1]` for each n.
        later = [np.asarray((self._stays @ table[:, :, n].T).T) for n in range(clocks)]
        detected = world.reward + later[0]
        half = np.append(np.full(self.other.num_cells, 0.5), 1.0)
        charge = world.safe_cost * world.stay_probability[:, None] * half
        found, sure = list[Array](), world.safe_detection[:, None]
        for n in reversed(range(clocks)):
            # Where the safe action misses as well, it is due in the next step.
            lost = later[min(n + 1, clocks - 1)]
            safe = kernel @ (sure * detected + (1.0 - sure) * lost) - charge
            if n == clocks - 1:
                found = [safe]
                continue
            missed = lost[to]
            over = world.detection[to, None] * (detected[to] - missed)
            gain = np.maximum(kernel.data[:, None] * over - self._prices, 0.0)
            free = kernel @ lost + self._sums @ gain
            found.insert(0, np.maximum(free, safe))
        return np.stack(found, axis=2)

    @cached_property
    def _sums(self) -> sparse.csr_array:
        """`[M, E]`, sums over the entries of a row."""
        return summing(row_index(self.world.kernel), self.world.num_cells)
