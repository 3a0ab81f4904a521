"""Schema of the world: grid, motion kernel, costs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from trackmdp.config.options import GROUPS, Option, choice, listed, option, refuse
from trackmdp.config.schema import ChoiceConfig, NodeConfig, Sizes
from trackmdp.errors import UserError

LARGEST = 1e15
"""Of a price or a reward: sums of them over cells and steps, and squares of those in a loss, stay far from overflow."""

BORDERS = ("renormalize", "inside", "clip", "exit")
MEMORIES = ("cell", "displacement", "displacement_gap", "two_displacements")


@dataclass(kw_only=True)
class GridConfig(NodeConfig):
    """The grid of cells and the limits on an episode."""

    size: Any = option(
        "N, cells along each side, or [rows, columns]; M cells in all, by default with a sensor in each",
        unit="cells",
        ge=3,
        pair=True,
    )
    t_max: int = option("T_max: free choices at n = 0 ... t_max, then the safe action", unit="steps", ge=0, le=16)
    max_steps: int | None = option(
        "truncate an episode after so many steps; null = only the exit ends it", unit="steps", ge=1, le=1_000_000
    )
    window: int | None = option(
        "W: only the sensors up to W rows and columns from the last located cell can be chosen, and moves out of that "
        "window are never seen; null = all",
        unit="cells",
        ge=0,
    )

    @property
    def num_cells(self) -> int:
        """M."""
        rows, columns = self.sides
        return rows * columns

    @property
    def sides(self) -> tuple[int, int]:
        """(rows, columns)."""
        rows, columns = (self.size, self.size) if isinstance(self.size, int) else self.size
        return rows, columns


@dataclass(kw_only=True)
class TaskConfig(NodeConfig):
    """What the policy may know."""

    memory: str = option(
        "what a policy remembers at a detection: the cell; with it the displacement since the detection before, with "
        "or without the misses between; or the last displacement and the direction of the one before",
        choices=MEMORIES,
    )
    clip: int = option(
        "rows and columns up to which displacements are told apart; larger ones count as that", unit="cells", ge=1, le=8
    )

    def check(self, key: str, root: Any) -> None:
        """More than the cell is remembered where there is a learner of it, and paths to learn from."""
        if self.memory == "cell":
            return
        readers = [name for name, schema in GROUPS["algo"].items() if schema.remembers]
        if root.learns and not root.algo.remembers:
            expected = f"cell with algo={root.algo.name}; more is learned by {', '.join(readers)}"
            raise refuse(f"{key}.memory", self.memory, expected)
        if root.kernel.is_motion and not root.kernel.hides:
            expected = f"cell with kernel={root.kernel.name}, whose next move depends on the cell alone"
            raise refuse(f"{key}.memory", self.memory, expected)
        if root.kernel.hides and root.kernel.reveals:
            raise refuse(f"{key}.memory", self.memory, "cell with kernel.reveals=true: a detection tells all there is")

    def needs(self, task: Sizes, root: Any) -> dict[str, int]:
        """A set for every key and n, with what finding it takes; and exact evaluation where targets have a mode."""
        if self.memory == "cell" and not task.pair_bytes:
            return {}
        # Some six sensors a set, each 60 bytes while plans are put together, and a row pointer or two.
        return {"task.memory": task.num_keys * (task.t_max + 1) * 400 + task.pair_bytes}

    def ignored(self, root: Any) -> dict[str, str]:
        """Where the cell alone is remembered there is no displacement."""
        return {"clip": "with task.memory=cell"} if self.memory == "cell" else {}


@dataclass(kw_only=True)
class KernelConfig(ChoiceConfig):
    """Base of the group `kernel`: how the target moves.

    What a choice makes is called with the grid's size and the choice's options, and returns the `[M, M]` kernel.
    """

    is_motion: ClassVar[bool] = True
    hides: ClassVar[bool] = False
    """Whether the target has a mode beside its cell (`trackmdp.config.modes`)."""

    @property
    def source(self) -> str:
        """What a message about the kernel begins with."""
        return f"kernel={self.name}"


@choice("kernel", "random_support", makes="trackmdp.world.kernels:random_support")
@dataclass(kw_only=True)
class RandomSupportConfig(KernelConfig):
    """The paper's motion: Z random positions around each cell, one of low probability, the others equal."""

    support_size: int = option("Z, positions the target may move to, at most (2·radius+1)²", unit="cells", ge=1)
    radius: int = option("how far the target moves in one step", unit="cells", ge=1, le=8)
    low_probability: float = option("probability of the one unlikely position", unit="per step", gt=0, lt=1)
    exit_probability: float = option("probability of leaving the grid", unit="per step", ge=0, lt=1)
    border: str = option("what becomes of positions outside the grid", choices=BORDERS)
    seed: int = option("seed of the random positions", ge=0)

    def check(self, key: str, root: Any) -> None:
        """The positions fit into the window, and their probabilities under one."""
        window = (2 * self.radius + 1) ** 2
        if self.support_size > window:
            expected = f"an integer from 1 to {window} ({key}.radius={self.radius} gives {window} cells)"
            raise refuse(f"{key}.support_size", self.support_size, expected)
        if self.low_probability + self.exit_probability >= 1:
            expected = f"less than 1 - {key}.exit_probability = {1 - self.exit_probability:g}"
            raise refuse(f"{key}.low_probability", self.low_probability, expected)


@choice("kernel", "random_walk", makes="trackmdp.world.kernels:random_walk")
@dataclass(kw_only=True)
class RandomWalkConfig(KernelConfig):
    """A lazy random walk on the 4 or 8 neighbours."""

    stay: float = option("probability of staying in the cell", unit="per step", ge=0, le=1)
    diagonal: bool = option("whether the 4 diagonal neighbours are reached as well")
    exit_probability: float = option("probability of leaving the grid", unit="per step", ge=0, lt=1)
    border: str = option("what becomes of positions outside the grid", choices=BORDERS)


@choice("kernel", "drift", makes="trackmdp.world.kernels:drift")
@dataclass(kw_only=True)
class DriftConfig(KernelConfig):
    """A target that heads one way most of the time."""

    direction: float = option("heading, 0 = right, 90 = up", unit="degrees", ge=0, lt=360)
    persistence: float = option("probability of keeping to the heading", unit="per step", ge=0, le=1)
    exit_probability: float = option("probability of leaving the grid", unit="per step", ge=0, lt=1)
    border: str = option("what becomes of positions outside the grid", choices=BORDERS)


@choice("kernel", "table", makes="trackmdp.world.kernels:load_table")
@dataclass(kw_only=True)
class TableConfig(KernelConfig):
    """A table of your own: row i holds the probabilities of moving from cell i to each cell."""

    path: str = option("file with the M x M table", expects="a path to a .npy, .npz or .csv file", path=True)

    @property
    def source(self) -> str:
        """What a message about the kernel begins with."""
        return f"kernel.path={self.path}"


@choice("kernel", "tracks", makes="trackmdp.world.make:recorded")
@dataclass(kw_only=True)
class TracksConfig(KernelConfig):
    """No motion model but recorded tracks: learn from most of them, choose by some, and judge on those held out."""

    is_motion: ClassVar[bool] = False
    path: str = option(
        "file of cells (columns track, cell, or row and column, and, if wanted, step), or of positions",
        expects="a path to a .csv, .npz, .parquet, .geojson, .gpx, .txt (MOT-Challenge) or .xml (SUMO) file",
        path=True,
    )
    format: str | None = option(
        "what the file holds; null = as its ending and columns say. points = a table of id, time and x, y or lat, lon, "
        "as of AIS and ADS-B; sumo = fcd-output",
        choices=("cells", "points", "geojson", "gpx", "mot", "sumo"),
    )
    step: float | None = option("positions: time from one cell of a track to the next", unit="s; mot: frames", gt=0)
    cell: float | None = option("positions: side of a cell", unit="m; mot: pixels", gt=0)
    max_gap: float | None = option(
        "positions: longest time between two reports that a straight line bridges; longer ones cut the track; null = 3 "
        "steps",
        unit="s; mot: frames",
        gt=0,
    )
    origin: list[float] | None = option(
        "positions: corner of the grid with the least coordinates, [x, y] or [lon, lat]; null = the middles of grid "
        "and positions agree",
    )
    crs: str | None = option(
        "positions as lat, lon: projection to metres; null = the UTM zone where they lie",
        expects="a code such as EPSG:2056",
        pattern="[A-Za-z]+:[0-9]{1,9}",
    )
    ends: str = option(
        "what the end of a track is: exit = the target left the grid, cut = the recording stopped",
        choices=("exit", "cut"),
    )
    starts: str = option(
        "where episodes begin while learning: first = where a track does, anywhere = at any recorded point",
        choices=("first", "anywhere"),
    )
    held_out: float = option(
        "share of the tracks for the last figures, which no learner and no choice sees", gt=0, lt=1
    )
    validation: float = option(
        "share of the tracks for figures while learning, best.pt and Optuna; nothing learns from them", gt=0, lt=1
    )
    seed: int = option("seed of the draw of these two", ge=0)
    min_length: int | None = option(
        "fewest cells of a track; null = grid.t_max + 3, a whole path of a policy", unit="cells", ge=1
    )
    markov: bool = option("take the next move to depend on the cell alone, so that moves of different tracks combine")

    def check(self, key: str, root: Any) -> None:
        """Recorded tracks hold no motion model: nothing that reads one goes with them."""
        if self.origin is not None and len(self.origin) != 2:
            raise refuse(f"{key}.origin", self.origin, "[x, y], or [lon, lat], or null")
        if root.needs_motion:
            raise refuse(key, self.name, "a motion model, which train and evaluate do without")
        if any(node.episodes_only for node in root.log.values()):
            *some, last = (name for name, schema in GROUPS["log"].items() if not schema.episodes_only)
            expected = f"none but {', '.join(some)} and {last} with kernel=tracks, without a motion model"
            raise refuse("log", listed(root.log), expected)
        baseline = getattr(root, "baseline", None)
        if baseline is not None and baseline.reads_motion:
            known = [name for name, schema in GROUPS["baseline"].items() if not schema.reads_motion]
            expected = f"{', '.join(known[:-1])} or {known[-1]} with kernel=tracks, without a motion model"
            raise refuse("baseline", baseline.name, expected)


@dataclass(kw_only=True)
class CostConfig(ChoiceConfig):
    """Base of the group `cost`: what sensing earns and costs.

    What a choice makes is called with the grid's size and the choice's options, and returns r, c `[M]` and D.
    """


@choice("cost", "paper", makes="trackmdp.world.make:paper_cost")
@dataclass(kw_only=True)
class PaperCostConfig(CostConfig):
    """The paper's rewards: r for a detection, c per sensor switched on, D for the safe action."""

    reward: float = option("r, earned by a detection", unit="reward", ge=1 / LARGEST, le=LARGEST)
    sensor: Any = option(
        "c, price of one sensor switched on for one step, for all sensors or for each",
        unit="reward per sensor-step",
        expects="a number from 0 to 1e15, a list of one per sensor, or a path to a .npy or .csv file of one per sensor",
        path=True,
    )
    safe: float | None = option(
        "D, price of the safe action; null = the sum of all sensors' prices", unit="reward", ge=0, le=LARGEST
    )

    def check(self, key: str, root: Any) -> None:
        """One price for all sensors, or one for each; a file is read later."""
        price = Option("", ge=0, le=LARGEST, kind=float)
        count, each = root.sensor.count(root.grid), "sensor" if root.sensor.covers else "cell"
        _check_per_cell(f"{key}.sensor", self.sensor, count, price, "number from 0 to 1e15", each)


@dataclass(kw_only=True)
class SensorConfig(ChoiceConfig):
    """Base of the group `sensor`: what a sensor that is on sees of the target in its cell.

    What a choice makes is called with the grid's size and the choice's options, and returns arguments of `Task`.
    """

    covers: ClassVar[bool] = False
    """Whether a sensor covers a set of cells, so that there need not be one in each cell."""

    def count(self, grid: GridConfig) -> int | None:
        """S, how many sensors there are; None where only a file tells."""
        return grid.num_cells


@choice("sensor", "perfect", makes="trackmdp.world.sensors:perfect")
@dataclass(kw_only=True)
class PerfectSensorConfig(SensorConfig):
    """The paper's sensors: one that is on always locates the target in its cell."""


@choice("sensor", "miss", makes="trackmdp.world.sensors:miss")
@dataclass(kw_only=True)
class MissConfig(SensorConfig):
    """Sensors that miss: one that is on reports the target in its cell with probability p_d, and never another cell."""

    p_d: Any = option(
        "p_d, probability that a sensor that is on reports the target in its cell, for all cells or for each",
        expects="a number above 0, at most 1, a list of one per cell, or a path to a .npy or .csv file of one per cell",
        path=True,
    )
    p_s: Any = option(
        "p_s, the same of the safe action; below 1 it is repeated, at its full price, until it locates the target",
        expects="a number above 0, at most 1, a list of one per cell, or a path to a .npy or .csv file of one per cell",
        path=True,
    )

    def check(self, key: str, root: Any) -> None:
        """One probability for all cells, or one for each; a file is read later."""
        for name in ("p_d", "p_s"):
            number = Option("", gt=0, le=1, kind=float)
            given = getattr(self, name)
            _check_per_cell(f"{key}.{name}", given, root.grid.num_cells, number, "number above 0, at most 1")


@choice("sensor", "false_alarm", makes="trackmdp.world.sensors:false_alarm")
@dataclass(kw_only=True)
class FalseAlarmConfig(SensorConfig):
    """For evaluate alone: sensors that also report targets that are not there; a policy believes each report."""

    p_d: Any = option(
        "p_d, probability that a sensor that is on reports the target in its cell, for all cells or for each",
        expects="a number above 0, at most 1, a list of one per cell, or a path to a .npy or .csv file of one per cell",
        path=True,
    )
    p_f: float = option(
        "p_f, probability that a sensor that is on reports in a step in which the target is not there", ge=0, lt=1
    )

    def check(self, key: str, root: Any) -> None:
        """Robustness of a policy made without them, and nothing else."""
        if not hasattr(root, "baseline"):
            raise refuse(
                key, self.name, "perfect or miss; policies are evaluated with false alarms, never made for them"
            )
        if root.log:
            raise refuse("log", listed(root.log), f"[] with {key}={self.name}, where nothing is simulated")
        number = Option("", gt=0, le=1, kind=float)
        _check_per_cell(f"{key}.p_d", self.p_d, root.grid.num_cells, number, "number above 0, at most 1")


@choice("sensor", "footprint", makes="trackmdp.world.sensors:footprint")
@dataclass(kw_only=True)
class FootprintConfig(SensorConfig):
    """Wide sensors: each covers several cells, and if on it always locates the target in any of them, never misses."""

    covers: ClassVar[bool] = True
    radius: float = option(
        "how far from its own cell the centres of the cells are that a sensor covers", unit="cells", ge=0
    )
    spacing: int = option("rows and columns from one sensor to the next, on a lattice", unit="cells", ge=1)
    path: str | None = option(
        "file in place of the lattice: a row per sensor, 1 in the column of each cell that it covers",
        expects="a path to a .npz (scipy.sparse.save_npz or an array), .npy or .csv file",
        path=True,
    )

    def count(self, grid: GridConfig) -> int | None:
        """As many as the lattice has places."""
        rows, columns = (len(lattice(side, self.spacing)) for side in grid.sides)
        return None if self.path is not None else rows * columns

    def check(self, key: str, root: Any) -> None:
        """What footprints do not go together with."""
        if self.path is not None and Path(self.path).suffix not in (".npz", ".npy", ".csv"):
            raise refuse(f"{key}.path", self.path, "a path to a .npz, .npy or .csv file")
        if root.grid.window is not None:
            raise refuse("grid.window", root.grid.window, f"null with {key}={self.name}, whose sensors lie at no cell")
        self._check_solver(key, root)
        if root.kernel.hides:
            raise refuse("kernel", root.kernel.name, f"a kernel without a hidden mode with {key}={self.name}")
        if getattr(root, "task", None) is not None and root.task.memory != "cell":
            raise refuse("task.memory", root.task.memory, f"cell with {key}={self.name}")

    def _check_solver(self, key: str, root: Any) -> None:
        """What plans and proves for sensors of one cell alone."""
        for group in ("solver", "baseline"):
            planner = getattr(root, group, None)
            if planner is not None and not planner.knows_footprints:
                known = [name for name, schema in GROUPS[group].items() if schema.knows_footprints]
                raise refuse(group, planner.name, f"one of {', '.join(known)} with {key}={self.name}")
        if root.learns and not root.algo.knows_footprints:
            known = [name for name, schema in GROUPS["algo"].items() if schema.knows_footprints]
            raise refuse("algo", root.algo.name, f"one of {', '.join(known)} with {key}={self.name}")
        if getattr(root, "verify", False):
            raise refuse("verify", True, f"false with {key}={self.name}: the theorems are on sensors of one cell")
        if (partition := getattr(root, "partition", None)) is not None and partition.block is not None:
            raise refuse("partition.block", partition.block, f"null with {key}={self.name}")

    def ignored(self, root: Any) -> dict[str, str]:
        """A file holds the footprints themselves."""
        why = f"with sensor.path={self.path}"
        return {} if self.path is None else {"radius": why, "spacing": why}


def lattice(side: int, spacing: int) -> range:
    """Rows, or columns, of a lattice on `side` of them; with a spacing of 3, 0 3 6 9 of 10, and 1 4 7 of 9."""
    return range((side - 1) % spacing // 2, side, spacing)


def _check_per_cell(
    key: str, value: Any, count: int | None, number: Option, allowed: str, each_of: str = "cell"
) -> None:
    """Refuse what is neither one number for all cells or sensors, nor a list of one for each, nor the name of a table.

    Such options are declared Any, since OmegaConf has no union of number, list and text; so values are checked here.

    Raises:
        UserError: it is something else.
    """
    if isinstance(value, list):
        if count is not None and len(value) != count:
            raise UserError(f"{key}: {len(value)} values, expected one number or {count} (one per {each_of})")
        for index, each in enumerate(value):
            if each is None or not number.allows(each):
                raise refuse(f"{key}[{index}]", each, f"a {allowed}")
        return
    fine = Path(value).suffix in (".npy", ".csv") if isinstance(value, str) else number.allows(value)
    if value is None or not fine:
        several = "" if count is None else f" of {count} of them"
        expected = f"a {allowed}, a list{several} (one per {each_of}), or a path to a .npy or .csv file"
        raise refuse(key, value, expected)
