"""Accuracy against sensors per step over all prices of a sensor, D fixed: one solve for each slope that is tried.

At a price c the best policy lies where a line of slope c / r touches the frontier (`trackmdp.solvers.tradeoff`).
Between two corners the next price is the slope of their chord: a policy above the chord is a new corner, and if there
is none, the chord is an edge of the frontier. An edge is left as it is once the lines of its corners meet less than
`resolution` above it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from typing import Any

import numpy as np

from trackmdp.arrays.numbers import REAL
from trackmdp.arrays.types import Array
from trackmdp.config.baselines import BaselineConfig
from trackmdp.config.compose import compose, default, given
from trackmdp.config.sensors import LARGEST_PRICE
from trackmdp.errors import UserError
from trackmdp.policies.table import PolicyTable
from trackmdp.solvers.solve import run_solver
from trackmdp.solvers.tradeoff import ROUNDING, Corner, Tradeoff, height, slope, upper_hull
from trackmdp.solvers.value import value_of
from trackmdp.world.group import check_problem
from trackmdp.world.model import World
from trackmdp.world.problem import Problem, modelled

_LEAST = 1e-6
"""c / r beside price 0: there a sensor that brings nothing costs nothing, and may be on."""
_FACTOR = 4.0
"""From one price to the next, until no sensor is worth its price."""


@dataclass(frozen=True)
class FrontierProgress:
    """Prices solved for, corners found, and how far an edge may still be below the next corner."""

    prices: int
    corners: int
    left: float
    seconds: float

    def __str__(self) -> str:
        counts = f"{self.prices} prices  {self.corners} corners"
        return f"{self.seconds:.0f} s  {counts}  {self.left:.2g} left"


Watch = Callable[[FrontierProgress], None]


def frontier(
    world: Problem,
    solver: str = default("solver", "frontier"),
    *,
    resolution: float = default("resolution", "frontier"),
    nodes: int = default("solver.nodes", "frontier"),
    time_limit: float | None = default("solver.time_limit", "frontier"),
    near: float | None = None,
    on_progress: Watch | None = None,
    **options: Any,
) -> Tradeoff:
    """The best accuracy for every number of sensors per step: policies, their prices, and a bound on all others.

    The price of a sensor goes from 0 to the price at which no sensor pays. D stays `world.safe_cost`: where it is above
    0, its payments are part of the objective, and the frontier is of accuracy less D / r for each safe action.
    The safe action counts as no sensor.

    Args:
        world: the problem with its motion model. Of its prices only the ratios count, and D.
        solver: finds the policy at each price, as in `solve`; with another one than ``optimal`` the corners are its
            policies, under a bound on all.
        resolution: no corner is looked for less than this above an edge; in accuracy.
        nodes: work at each price after which `optimal` stops closing the bracket.
        time_limit: seconds at each price; None: no limit.
        near: sensors per step; only the edge there is resolved, so that `at` and `worth` are exact there, and no other
            corner is looked for. None: all of them.
        on_progress: called after each price.
        **options: the solver's own, such as ``tolerance=1e-8``.

    Raises:
        UserError: a name, a type or a range is wrong, or there is no motion model.

    Example:
        >>> from trackmdp.world.make import make_world
        >>> found = frontier(make_world("drift", size=3, safe_cost=0))
        >>> found.certified, found.corners[0].sensors, round(found.corners[-1].accuracy, 6)
        (True, 0.0, 1.0)
    """
    if near is not None and not (isinstance(near, REAL) and near >= 0):  # nor nan
        raise UserError(f"near={near}: expected a number of sensors >= 0")
    own = {f"solver.{name}": value for name, value in options.items()}
    named = {"solver": solver, "solver.nodes": nodes, "solver.time_limit": time_limit}
    cfg = compose("frontier", given(named | {"resolution": resolution}) | own)
    return trace(world, cfg.solver, cfg.resolution, on_progress, near)


def trace(
    problem: Problem,
    choice: BaselineConfig,
    resolution: float,
    on_progress: Watch | None = None,
    near: float | None = None,
) -> Tradeoff:
    """`frontier` with the solver of a config.

    Raises:
        UserError: there is no motion model, episodes are cut, or the target is never in the grid after its start.
    """
    check_problem(problem, "frontier")
    world = modelled(problem, "frontier")
    if world.max_steps is not None:
        raise UserError(
            f"grid.max_steps={world.max_steps}: only whole episodes are solved, expected null"
        )
    if not world.kernel.nnz:
        raise UserError("kernel: the target leaves at its first step, expected one that stays")
    if world.reward <= 0:
        raise UserError(f"reward={world.reward:g}: expected a number > 0")
    run = _Trace(world, choice, resolution, on_progress, near)
    try:
        run.ends()
        run.refine()
    except KeyboardInterrupt:
        if not run.hull:
            raise
        run.interrupted = True
    return run.result()


@dataclass(eq=False)
class _Trace:
    """The corners and lines found so far."""

    world: World
    choice: BaselineConfig
    resolution: float
    on_progress: Watch | None
    near: float | None
    interrupted: bool = False

    def __post_init__(self) -> None:
        self.weights = relative_prices(self.world.cost)
        self.equal_prices = bool((self.weights[self.world.available] == 1.0).all())
        self.hull: list[Corner] = []
        self.slopes: list[float] = []
        self.bounds: list[float] = []
        self.steps = 0.0
        self.started = time.monotonic()

    def solve(self, price: float, start: PolicyTable | None = None) -> Corner:
        """The policy of one price; its line, and itself if it is a corner, are kept."""
        world = replace(self.world, cost=price * self.weights)
        found = run_solver(world, self.choice, start=start)
        figures = found.evaluation
        # The same for every policy: sensing does not move the target.
        self.steps = float(figures.steps.mean())
        safe = world.safe_cost / world.reward * figures.safe_per_episode / self.steps
        corner = Corner(
            **{each.name: getattr(found, each.name) for each in fields(found)},
            price=price,
            sensors=self.spent(found.table, figures.sensors_per_step),
            net=figures.accuracy - safe,
        )
        slopes = [*self.slopes, price / world.reward]
        bounds = [*self.bounds, corner.upper / (world.reward * self.steps)]
        hull = upper_hull([*self.hull, corner])
        # All or none of them: nothing is called here, after which Python would hear Ctrl-C.
        self.slopes, self.bounds, self.hull = slopes, bounds, hull
        # Only with the corner kept: an interrupted search has a policy and a bound as well.
        if found.interrupted:
            raise KeyboardInterrupt
        return corner

    def spent(self, table: PolicyTable, sensors: float) -> float:
        """Sensors per step, each counted with its price over the mean one."""
        if self.equal_prices:
            return sensors
        # Without rewards the value of an episode is its payment for sensors.
        paid = replace(self.world, cost=self.weights, reward=0.0, safe_cost=0.0)
        return max(0.0, -value_of(paid, table).aihtr / self.steps)

    def ends(self) -> None:
        """The corners of the lowest and of the highest price."""
        self.solve(0.0)
        self.solve(_LEAST * self.world.reward)
        price = self.world.reward + self.world.safe_cost
        # The dearest sensor has a price as well, also after rounding.
        most = 0.9 * LARGEST_PRICE / float(np.nanmax(self.weights))
        while self.solve(min(price, most)).sensors > 0 and price < most:
            price *= _FACTOR

    def refine(self) -> None:
        """Solve at the slope of the edge that may be farthest below a further corner, until all are resolved."""
        while (edge := self.widest()) is not None:
            room, left, right = edge
            if self.on_progress is not None:
                seconds = time.monotonic() - self.started
                self.on_progress(FrontierProgress(len(self.slopes), len(self.hull), room, seconds))
            self.solve(slope(left, right) * self.world.reward, start=left.table)

    def widest(self) -> tuple[float, Corner, Corner] | None:
        """The edge with the most room for a further corner, and the room; None where all are resolved.

        The room is that below the lines through the corners found, not below the bounds: where a bracket stays open,
        no solve at further prices closes it.
        """
        slopes = np.array(self.slopes)
        net, sensors = np.array([(each.net, each.sensors) for each in self.hull]).T
        touching: Array = (net - slopes[:, None] * sensors).max(axis=1)
        pairs = list(pairwise(self.hull))
        if self.near is not None:
            pairs = [each for each in pairs if each[0].sensors < self.near <= each[1].sensors]
        rooms = [(height(slopes, touching, *pair), *pair) for pair in pairs]
        widest = max(rooms, key=lambda room: room[0], default=None)
        enough = self.resolution if self.near is None else ROUNDING
        return None if widest is None or widest[0] <= enough else widest

    def result(self) -> Tradeoff:
        return Tradeoff(
            tuple(self.hull),
            np.array(self.slopes),
            np.array(self.bounds),
            self.steps,
            self.world.reward,
            self.world.safe_cost,
            self.equal_prices,
            self.resolution,
            time.monotonic() - self.started,
            self.interrupted,
        )


def relative_prices(cost: Array) -> Array:
    """`[S]`, each price over their mean; 1 where all are free, nan where there is no sensor."""
    known = cost[~np.isnan(cost)]
    mean = float(known.mean())
    equal = mean == 0 or np.ptp(known) == 0
    return np.where(np.isnan(cost), np.nan, 1.0 if equal else cost / (mean or 1.0))
