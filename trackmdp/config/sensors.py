"""Schema of prices and sensors."""

from __future__ import annotations

import re
from typing import Any

from trackmdp.config.options import (
    TABLE,
    ChoiceConfig,
    Option,
    Reasons,
    choice,
    count_option,
    file_option,
    listed,
    option,
    refuse,
    require_able,
)
from trackmdp.config.world import GridConfig
from trackmdp.errors import UserError

LARGEST_PRICE = 1e15
"""Largest price or reward: sums over cells and steps, and their squares in a loss, stay far from overflow."""


class CostConfig(ChoiceConfig):
    """Base of the group `cost`: rewards and prices.

    The code of a choice gets the size of the grid and the options of the choice, and returns r, c `[M]` and D.
    """


@choice("cost", "paper", makes="trackmdp.sensing.makers:paper_cost")
class PaperCostConfig(CostConfig):
    """The paper's rewards: r for a detection, c per sensor switched on, D for the safe action."""

    reward: float = option(
        "r, earned by a detection", unit="reward", ge=1 / LARGEST_PRICE, le=LARGEST_PRICE
    )
    sensor: Any = file_option(
        "c, price of one sensor switched on for one step, for all sensors or for each",
        "a number from 0 to 1e15, or one per sensor: a list (null = no sensor), or a path to a .npy, .npz or "
        ".csv file (nan = no sensor)",
        unit="reward per sensor-step",
    )
    safe: float | None = option(
        "D, price of the safe action; null = the sum of all sensors' prices",
        unit="reward",
        ge=0,
        le=LARGEST_PRICE,
    )
    budget: int | None = option(
        "B, sensors that may be on in one step, the safe action apart; null = any number",
        unit="sensors",
        ge=0,
    )
    mean_budget: float | None = option(
        "of solve: sensors per step on average; the best two policies around it, and how often to draw each",
        unit="sensors per step",
        ge=0,
    )

    def check(self, key: str, root: Any) -> None:
        """One price for all sensors, or one for each; a file is read later."""
        partition = getattr(root, "partition", None)
        by_blocks = partition is not None and partition.block is not None
        if self.budget is not None:
            require_able(root, "knows_budget", f"with {key}.budget={self.budget}")
            if root.any_number:
                expected = "null here, where any number of sensors is on"
                raise refuse(f"{key}.budget", self.budget, expected)
        if self.mean_budget is not None:
            # The price is the multiplier of the budget: the edge of the frontier has one only where all are alike.
            solver = getattr(root, "solver", None)
            if partition is None or by_blocks or solver is None or solver.name != "optimal":
                expected = "null but for solve with solver=optimal in one block"
                raise refuse(f"{key}.mean_budget", self.mean_budget, expected)
            if self.budget is not None or not isinstance(self.sensor, (int, float)):
                expected = "one price for all sensors beside it, and no cost.budget"
                raise refuse(f"{key}.mean_budget", self.mean_budget, expected)
        price = Option("", ge=0, le=LARGEST_PRICE, kind=float)
        count, each = root.sensor.count(root.grid), "sensor" if root.sensor.covers else "cell"
        _check_per_cell(
            f"{key}.sensor", self.sensor, count, price, "number from 0 to 1e15", each, some=True
        )

    def ignored(self, root: Any) -> Reasons:
        """One price for all sensors, where the command goes through all prices and D is given."""
        one = isinstance(self.sensor, (int, float))
        if root.all_prices and one and self.safe is not None:
            return {"sensor": "where all prices are gone through, and cost.safe is given"}
        return {}


class SensorConfig(ChoiceConfig):
    """Base of the group `sensor`: detections of a sensor that is on.

    The code of a choice gets the size of the grid and the options of the choice, and returns arguments of `Task`.
    """

    covers = False
    """Whether a sensor covers a set of cells, so that there need not be one in each cell."""

    def count(self, grid: GridConfig) -> int | None:
        """S, the number of sensors; None where it is in a file."""
        return grid.num_cells

    def _check_solver(self, key: str, root: Any) -> None:
        """Refuse solvers, learners and proofs for sensors of one cell, where each covers several."""
        require_able(root, "knows_footprints", f"with {key}={self.name}")
        if getattr(root, "verify", False):
            expected = "perfect or miss: the paper's theorems are on sensors of one cell"
            raise refuse(key, self.name, expected)


@choice("sensor", "perfect", makes="trackmdp.sensing.makers:perfect")
class PerfectSensorConfig(SensorConfig):
    """The paper's sensors: one that is on always locates the target in its cell."""


def _chance(help: str) -> Any:
    """An option of a probability above 0, for all cells or for each."""
    expects = "a number above 0, at most 1, or one per cell: a list, or a path to a .npy, .npz or .csv file"
    return file_option(help, expects)


@choice("sensor", "miss", makes="trackmdp.sensing.makers:miss")
class MissConfig(SensorConfig):
    """Sensors that miss: one that is on reports the target in its cell with probability p_d, and never another cell."""

    p_d: Any = _chance(
        "p_d, probability that a sensor that is on reports the target in its cell, for all cells or for each"
    )
    p_s: Any = _chance(
        "p_s, the same of the safe action; below 1 it is repeated, at its full price, until it locates the target"
    )

    def check(self, key: str, root: Any) -> None:
        """One probability for all cells, or one for each; a file is read later."""
        _check_chance(f"{key}.p_d", self.p_d, root)
        _check_chance(f"{key}.p_s", self.p_s, root)


@choice("sensor", "false_alarm", makes="trackmdp.sensing.makers:false_alarm")
class FalseAlarmConfig(SensorConfig):
    """For evaluate alone: sensors that also report targets that are not there; a policy believes each report."""

    p_d: Any = _chance(
        "p_d, probability that a sensor that is on reports the target in its cell, for all cells or for each"
    )
    p_f: float = option(
        "p_f, probability that a sensor that is on reports in a step in which the target is not there",
        ge=0,
        lt=1,
    )

    def check(self, key: str, root: Any) -> None:
        """Robustness of a policy made without them, and nothing else."""
        if not hasattr(root, "baseline"):
            raise refuse(
                key,
                self.name,
                "perfect, miss or footprint; policies are evaluated with false alarms, never made for them",
            )
        if root.log:
            raise refuse(
                "log", listed(root.log), f"[] with {key}={self.name}, where nothing is simulated"
            )
        _check_chance(f"{key}.p_d", self.p_d, root)


@choice("sensor", "footprint", makes="trackmdp.sensing.makers:footprint")
class FootprintConfig(MissConfig):
    """Wide sensors: each covers several cells, and reports a target in any of them with probability p_d of its cell."""

    covers = True
    radius: float = option(
        "distance from its own cell to the centres of the cells that a sensor covers",
        unit="cells",
        ge=0,
    )
    spacing: int = count_option(
        "rows and columns from one sensor to the next, on a lattice", unit="cells"
    )
    path: str | None = file_option(
        "file in place of the lattice: a row per sensor, 1 in the column of each cell that it covers, or the "
        "probability of a report there, a factor on p_d",
        "a path to a .npz (scipy.sparse.save_npz or an array), .npy or .csv file",
        pattern=TABLE,
    )

    def count(self, grid: GridConfig) -> int | None:
        """As many as the lattice has places."""
        rows, columns = (len(lattice(side, self.spacing)) for side in grid.sides)
        return None if self.path is not None else rows * columns

    def check(self, key: str, root: Any) -> None:
        """Options that exclude footprints are refused."""
        super().check(key, root)
        self._check_solver(key, root)

    def ignored(self, root: Any) -> Reasons:
        """A file holds the footprints themselves."""
        why = f"with sensor.path={self.path}"
        return {} if self.path is None else {"radius": why, "spacing": why}


def lattice(side: int, spacing: int) -> range:
    """Rows, or columns, of a lattice on `side` of them; with a spacing of 3, 0 3 6 9 of 10, and 1 4 7 of 9."""
    return range((side - 1) % spacing // 2, side, spacing)


def _check_chance(key: str, value: Any, root: Any) -> None:
    number = Option("", gt=0, le=1, kind=float)
    _check_per_cell(key, value, root.grid.num_cells, number, "number above 0, at most 1")


def _check_per_cell(
    key: str,
    value: Any,
    count: int | None,
    number: Option,
    allowed: str,
    each_of: str = "cell",
    *,
    some: bool = False,
) -> None:
    """Refuse a value that is neither one number, nor a list of one for each cell or sensor, nor the name of a table.

    With `some`, an entry of a list may be null.

    Such options are declared Any, since OmegaConf has no union of number, list and text; so values are checked here.

    Raises:
        UserError: it is something else.
    """
    if isinstance(value, list):
        if count is not None and len(value) != count:
            raise UserError(
                f"{key}: {len(value)} values, expected one number or {count} (one per {each_of})"
            )
        for index, each in enumerate(value):
            if not (some if each is None else number.allows(each)):
                raise refuse(f"{key}[{index}]", each, f"a {allowed}" + ", or null" * some)
        return
    fine = re.fullmatch(TABLE, value) if isinstance(value, str) else number.allows(value)
    if value is None or not fine:
        several = "" if count is None else f" of {count} of them"
        expected = f"a {allowed}, a list{several} (one per {each_of}), or a path to a .npy, .npz or .csv file"
        raise refuse(key, value, expected)
