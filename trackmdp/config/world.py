"""Schema of the world: grid, memory of policies, motion kernel."""

from __future__ import annotations

from typing import Any

from trackmdp.config.options import (
    ChoiceConfig,
    Needs,
    NodeConfig,
    Reasons,
    choice,
    count_option,
    file_option,
    option,
    refuse,
    require_able,
    share_option,
)
from trackmdp.errors import UserError

BORDERS = ("renormalize", "inside", "clip", "exit")
CRS_CODE = "[A-Za-z]+:[0-9]{1,9}"
LARGEST_CLIP = 8
"""Rows and columns up to which displacements can differ: 289 of them."""

MEMORIES = {
    "cell": "trackmdp.memory.keys:Cell",
    "displacement": "trackmdp.memory.keys:Displacement",
    "displacement_gap": "trackmdp.memory.keys:DisplacementGap",
    "two_displacements": "trackmdp.memory.keys:TwoDisplacements",
}
"""Memories of policies: the class of each name. A plugin adds its own, before its configs are composed."""


class GridConfig(NodeConfig):
    """The grid of cells and the limits on an episode."""

    size: Any = option(
        "N, cells along each side, or [rows, columns]; M cells in all, by default with a sensor in each",
        unit="cells",
        ge=1,
        pair=True,
    )
    t_max: int = option(
        "T_max: free choices at n = 0 ... t_max, then the safe action", unit="steps", ge=0, le=16
    )
    max_steps: int | None = count_option(
        "truncate an episode after so many steps; null = only the exit ends it",
        unit="steps",
        le=1_000_000,
    )
    window: int | None = option(
        "W: only the sensors up to W rows and columns from the last located cell can be chosen, and moves out of that "
        "window are never seen; null = all",
        unit="cells",
        ge=0,
        le=1024,
    )

    cell: float | None = option(
        "side of a cell; with it and grid.origin cells have positions", unit="m; mot: pixels", gt=0
    )
    origin: list[float] | None = option(
        "corner of the grid with the least coordinates, [x, y] or [lon, lat]; null = not known, with kernel=tracks the "
        "middle of the positions that are not held out"
    )
    crs: str | None = option(
        "projection of lat, lon to metres; null = positions are x, y, with kernel=tracks the UTM zone of lat, lon",
        expects="a code such as EPSG:2056",
        pattern=CRS_CODE,
    )

    def check(self, key: str, root: Any) -> None:
        """An origin is two numbers, and places a grid together with the side of a cell."""
        if self.origin is not None and len(self.origin) != 2:
            raise refuse(f"{key}.origin", self.origin, "[x, y], or [lon, lat], or null")
        if root.kernel.is_motion:
            for name, needed in (("origin", "cell"), ("crs", "origin")):
                if getattr(self, name) is not None and getattr(self, needed) is None:
                    raise UserError(f"{key}.{needed}: missing, expected beside {key}.{name}")

    def ignored(self, root: Any) -> Reasons:
        """The side of a cell, of a grid without a place whose motion is not in metres."""
        metres = not root.kernel.is_motion or hasattr(root.kernel, "cell")
        return {} if metres or self.origin else {"cell": "without grid.origin"}

    @property
    def place(self) -> dict[str, Any]:
        """Side of a cell, corner and projection."""
        return {"cell": self.cell, "origin": self.origin, "crs": self.crs}

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


class TaskConfig(NodeConfig):
    """Memory of policies."""

    memory: str = option(
        "memory of a policy at a detection: the cell; with it the displacement since the detection before, with "
        "or without the misses between; or the last displacement and the direction of the one before",
        choices=MEMORIES,
    )
    clip: int = count_option(
        "rows and columns up to which displacements differ; larger ones count as that",
        unit="cells",
        le=LARGEST_CLIP,
    )

    def check(self, key: str, root: Any) -> None:
        """A memory of more than the cell takes a learner of it."""
        if self.memory != "cell":
            require_able(root, "remembers", f"with {key}.memory={self.memory}")

    def needs(self, task: Any, root: Any) -> Needs:
        """A set for every key and n, and its search."""
        if self.memory == "cell":
            return {}
        # Some six sensors a set, each 60 bytes while plans are put together, and a row pointer or two.
        return {"task.memory": task.num_keys * (task.t_max + 1) * 400}

    def ignored(self, root: Any) -> Reasons:
        """A memory of the cell alone has no displacement."""
        return {"clip": "with task.memory=cell"} if self.memory == "cell" else {}


class KernelConfig(ChoiceConfig):
    """Base of the group `kernel`: how the target moves.

    The code of a choice gets the size of the grid and the options of the choice, and returns the `[M, M]` kernel.
    """

    is_motion = True
    hides = False
    """Whether the target has a mode beside its cell (`trackmdp.config.hidden_kernels`)."""


class ExitingConfig(KernelConfig):
    """Common options of the kernels of moves around each cell."""

    exit_probability: float = option("probability of leaving the grid", unit="per step", ge=0, lt=1)
    border: str = option("rule for positions outside the grid", choices=BORDERS)


@choice("kernel", "random_support", makes="trackmdp.motion.kernels:random_support")
class RandomSupportConfig(ExitingConfig):
    """The paper's motion: Z random positions around each cell, one of low probability, the others equal."""

    support_size: int = count_option(
        "Z, positions the target may move to, at most (2·radius+1)²", unit="cells"
    )
    radius: int = count_option("reach of a move", unit="cells", le=8)
    low_probability: float = option(
        "probability of the one unlikely position", unit="per step", gt=0, lt=1
    )
    seed: int = option("seed of the random positions", ge=0)

    def check(self, key: str, root: Any) -> None:
        """The positions fit into the window, and their probabilities under one."""
        window = (2 * self.radius + 1) ** 2
        if self.support_size > window:
            expected = (
                f"an integer from 1 to {window} ({key}.radius={self.radius} gives {window} cells)"
            )
            raise refuse(f"{key}.support_size", self.support_size, expected)
        if self.low_probability + self.exit_probability >= 1:
            expected = f"less than 1 - {key}.exit_probability = {1 - self.exit_probability:g}"
            raise refuse(f"{key}.low_probability", self.low_probability, expected)

    def ignored(self, root: Any) -> Reasons:
        """A single position has all of the probability."""
        return {"low_probability": "with support_size=1"} if self.support_size == 1 else {}


@choice("kernel", "random_walk", makes="trackmdp.motion.kernels:random_walk")
class RandomWalkConfig(ExitingConfig):
    """A lazy random walk on the 4 or 8 neighbours."""

    stay: float = share_option("probability of staying in the cell", unit="per step")
    diagonal: bool = option("whether the 4 diagonal neighbours are reached as well")


@choice("kernel", "drift", makes="trackmdp.motion.kernels:drift")
class DriftConfig(ExitingConfig):
    """A target that heads one way most of the time."""

    direction: float = option("heading, 0 = right, 90 = up", unit="degrees", ge=0, lt=360)
    persistence: float = share_option("probability of keeping to the heading", unit="per step")


@choice("kernel", "table", makes="trackmdp.motion.kernels:load_table")
class TableConfig(KernelConfig):
    """A table of your own: row i holds the probabilities of moving from cell i to each cell."""

    path: str = file_option("file with the M x M table", "a path to a .npy, .npz or .csv file")


@choice("kernel", "tracks", makes="trackmdp.world.configured:recorded")
class TracksConfig(KernelConfig):
    """No motion model but recorded tracks: learn from most of them, choose by some, and judge on those held out."""

    is_motion = False
    path: str = file_option(
        "file of cells (columns track, cell, or row and column, and, if wanted, step), or of positions",
        "a path to a .csv, .npz, .parquet, .geojson, .gpx, .txt (MOT-Challenge) or .xml (SUMO) file",
    )
    format: str | None = option(
        "content of the file; null = by its ending and columns. points = a table of id, time and x, y or lat, lon, "
        "as of AIS and ADS-B; sumo = fcd-output",
        choices=("cells", "points", "geojson", "gpx", "mot", "sumo"),
    )
    columns: list[str] | None = option(
        "a table of positions: names of its columns, such as [id:device_id,time:seen]; of id, time, x, y, lat, lon",
        expects="one of id, time, x, y, lat, lon with its column, such as id:device_id",
        pattern="(id|time|x|y|lat|lon):.+",
    )
    step: float | None = option(
        "positions: time from one cell of a track to the next", unit="s; mot: frames", gt=0
    )
    max_gap: float | None = option(
        "positions: longest time between two reports that a straight line bridges; longer ones cut the track; null = 3 "
        "steps",
        unit="s; mot: frames",
        gt=0,
    )
    ends: str = option(
        "meaning of the end of a track: exit = the target left the grid, cut = the recording stopped",
        choices=("exit", "cut"),
    )
    starts: str | None = option(
        "start of episodes while learning: first = start of a track, anywhere = any recorded point; null = anywhere "
        "with grid.max_steps, so that what comes later is learned from too, else first",
        choices=("first", "anywhere"),
    )
    held_out: float = option(
        "share of the tracks for the last figures, kept from learners and choices", gt=0, lt=1
    )
    validation: float = option(
        "share of the tracks for figures while learning, best.pt and Optuna; nothing learns from them",
        gt=0,
        lt=1,
    )
    seed: int = option("seed of the draw of these two", ge=0)
    min_length: int | None = count_option(
        "fewest cells of a track; null = grid.t_max + 3, a whole path of a policy", unit="cells"
    )
    markov: bool = option(
        "take the next move to depend on the cell alone, so that moves of different tracks combine"
    )

    def check(self, key: str, root: Any) -> None:
        """Recorded tracks have no motion model: solvers and baselines that read one are refused."""
        if root.needs_motion:
            raise refuse(key, self.name, "a motion model, which train and evaluate do without")
        require_able(root, "without_motion", "with kernel=tracks, without a motion model")
