"""From arguments in Python to a world or to recorded tracks: `make_world` and `load_tracks`."""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, cast, overload

import numpy as np
import numpy.typing as npt

from trackmdp.arrays.numbers import array_of, whole_number
from trackmdp.config.compose import Default, compose, default, given
from trackmdp.config.options import GROUPS, options
from trackmdp.config.several import MOST_TARGETS
from trackmdp.errors import UserError
from trackmdp.grid.size import Size, grid_size
from trackmdp.recordings.tracks import Recorded
from trackmdp.world.configured import make_problem
from trackmdp.world.group import Group
from trackmdp.world.model import World
from trackmdp.world.problem import modelled

OF_TASK = {
    "size": "grid.size",
    "t_max": "grid.t_max",
    "max_steps": "grid.max_steps",
    "window": "grid.window",
    "cost": "cost.sensor",
    "safe_cost": "cost.safe",
    "reward": "cost.reward",
    "budget": "cost.budget",
    "memory": "task.memory",
    "clip": "task.clip",
}
"""Arguments of `make_world` and `load_tracks` -> options of the command line."""

_OF_MISSES = {"detection": "sensor.p_d", "safe_detection": "sensor.p_s"}
"""The same of sensors that miss."""

_OF_SENSORS = {
    "p_d": "detection",
    "p_s": "safe_detection",
    "sensor": "coverage, detection and safe_detection",
}
"""Names of the command line -> arguments of `make_world` and `load_tracks`."""

_OF_PLACE = {name: f"grid.{name}" for name in ("cell", "origin", "crs")}


@overload
def make_world(
    kernel: str = ..., *, size: Size = ..., targets: Literal[1] = ..., **options: Any
) -> World: ...
@overload
def make_world(kernel: str = ..., *, size: Size = ..., targets: int, **options: Any) -> Group: ...


def make_world(
    kernel: str = default("kernel"),
    *,
    size: Size = default("grid.size"),
    t_max: int = default("grid.t_max"),
    cost: npt.ArrayLike | str = default("cost.sensor"),
    safe_cost: float | None = default("cost.safe"),
    reward: float = default("cost.reward"),
    max_steps: int | None = default("grid.max_steps"),
    window: int | None = default("grid.window"),
    budget: int | None = default("cost.budget"),
    detection: npt.ArrayLike | str = 1.0,
    safe_detection: npt.ArrayLike | str = 1.0,
    coverage: Any = None,
    memory: str = default("task.memory"),
    clip: int = default("task.clip"),
    cell: float | None = default("grid.cell"),
    origin: Sequence[float] | None = default("grid.origin"),
    crs: str | None = default("grid.crs"),
    targets: int = 1,
    **kernel_options: Any,
) -> World | Group:
    """A world with one of the motion kernels; for a table of your own take `World` itself.

    The defaults are those of `conf/`, and the checks those of the command line.

    Args:
        kernel: name of the kernel, as in ``trackmdp solve kernel=...``: ``random_support``, ``random_walk``, ``drift``,
            ``table``, or one of an installed plugin; for targets with a mode, such as a heading or a velocity,
            ``heading``, ``regimes``, ``constant_velocity`` or ``coordinated_turn``.
        size: N of an N x N grid, or (rows, columns).
        t_max: T_max; the controller chooses freely at n = 0 ... t_max.
        cost: c, the price of one sensor for one step; one number, one per cell, or per sensor of `coverage` (nan: no
            sensor there), or a file.
        safe_cost: D; None: the sum of all sensors' prices.
        reward: r, earned by a detection.
        max_steps: episodes are truncated after so many steps; None: never.
        window: W; only sensors up to W rows and columns from the last located cell can be chosen. None: all can.
        budget: B; at most so many sensors on in a step. None: any number.
        detection: p_d, how likely a sensor that is on reports the target in its cell; as `cost`, in (0, 1].
        safe_detection: p_s, the same of the safe action, which is repeated until it locates; as `detection`.
        coverage: the cells that each of S sensors covers: a table or sparse matrix `[S, M]` of 0 and 1, or of
            probabilities that a sensor reports a target there, which are multiplied by p_d; or a file of one. None: one
            sensor in each cell.
        memory: the policy's key at a detection, as in `load_tracks`; the cell, unless targets have a mode.
        clip: rows and columns up to which displacements are distinguished.
        cell: side of a cell, in metres or units of x and y; with `origin` it gives the grid a place (`World.place`).
        origin: corner of the grid with the least coordinates, (x, y), or (lon, lat) with `crs`.
        crs: code of the projection of lat and lon to metres, such as ``EPSG:2056``.
        targets: K; above 1 the result is a `Group` of as many targets that move alike. For targets that move each in
            its own way take ``Group([world, other])``.
        **kernel_options: the kernel's own, such as ``support_size=5`` (``trackmdp solve --help`` lists them), or
            ``reveals=True`` where detections reveal the mode.

    Returns:
        The world, its `modes` above 1 where targets have a mode.

    Raises:
        UserError: a name, a type or a range is wrong, or the kernel breaks a rule.

    Example:
        >>> make_world("drift", size=5, direction=90).num_cells
        25
        >>> make_world("heading", size=4, reveals=True).num_keys
        128
    """
    arguments = locals() | kernel_options
    for name in ("kernel", "targets", "kernel_options"):
        del arguments[name]
    if not isinstance(kernel, str | Default):
        raise UserError(
            f"make_world: kernel: a {type(kernel).__name__}, expected a name; World(kernel, size, cost=..., t_max=...) "
            "takes a table"
        )
    words = given({"kernel": kernel}) | _words(arguments)
    targets = whole_number("targets", targets, 1, MOST_TARGETS)
    made = make_problem(_config(words, targets), coverage=_in_memory(coverage))
    world = modelled(made, f"kernel={kernel}")
    return world if targets == 1 else Group([world] * targets)


@overload
def load_tracks(
    path: str | Path | Any, size: Size = ..., *, targets: Literal[1] = ..., **options: Any
) -> Recorded: ...
@overload
def load_tracks(
    path: str | Path | Any, size: Size = ..., *, targets: int, **options: Any
) -> Group: ...


def load_tracks(
    path: str | Path | Any,
    size: Size = default("grid.size"),
    *,
    targets: int = 1,
    **options: Any,
) -> Recorded | Group:
    """Recorded tracks in place of a motion model: most to learn from, some to choose by, some held out to evaluate on.

    Args:
        path: a file of cells (.csv or .npz with columns track, cell, or row and column, and, if wanted, step), or one
            of positions: a table (.csv, .parquet) of id, time and x, y or lat, lon, as of AIS and ADS-B; GeoJSON; GPX;
            MOT-Challenge text; SUMO's fcd-output. Positions need `step` and `cell`; see `Recorded.loaded` for the
            counts of omitted ones, `Recorded.place` for where the grid lies. Or such a table as a DataFrame of pandas.
        size: N of an N x N grid, or (rows, columns).
        targets: K; above 1 the result is a `Group`, of which so many tracks are followed at once: those whose times
            overlap, or where the recording has no times any.
        **options: of `make_world` all but the kernel's own: `t_max`, `cost`, `safe_cost`, `reward`, `max_steps`, at
            which tracks are cut, `window`, `budget`, `detection`, `safe_detection`, `coverage`, `clip`, `memory`
            (``cell``, ``displacement``, ``displacement_gap`` or ``two_displacements``), and `cell`, `origin` and `crs`:
            of positions the side of a cell is needed, the others follow from them. Those of ``kernel=tracks``
            (``trackmdp train kernel=tracks --help``): `format`, `step`, `columns` (a dict, or a list as there),
            `max_gap`, `ends`, `starts`, `held_out`, `validation`, `seed`, `min_length`, `markov`.

    Raises:
        UserError: the file is not of that form, a track is too short, or an option is wrong.

    Example:
        ``load_tracks("ais.csv", (40, 60), cell=500, step=60, max_gap=600, ends="cut")``
    """
    in_memory = hasattr(path, "columns") and hasattr(path, "to_numpy")
    if not (in_memory or isinstance(path, str | Path)):
        raise UserError(
            f"load_tracks: a {type(path).__name__}, expected the path of a file, or a DataFrame"
        )
    targets = whole_number("targets", targets, 1, MOST_TARGETS)
    source = "DataFrame.parquet" if in_memory else path  # a table of positions
    if isinstance(named := options.get("columns"), Mapping):
        options["columns"] = [f"{ours}:{theirs}" for ours, theirs in named.items()]
    words = {"kernel": "tracks", "kernel.path": source} | _words({"size": size, **options})
    frame = path if in_memory else None
    table = _in_memory(options.get("coverage"))
    made = cast(Recorded, make_problem(_config(words, targets), frame=frame, coverage=table))
    return made if targets == 1 else Group.of_tracks(made, targets)


def _config(words: dict[str, Any], targets: int) -> Any:
    """The checked config of a problem."""
    # `compare` has all options of a world, and no solver or learner that could refuse one of them; `evaluate` takes
    # several targets, and with a budget too where no sensor is on.
    if targets == 1:
        return compose("compare", words)
    return compose("evaluate", words | {"targets.count": targets, "baseline": "none"})


def _words(arguments: dict[str, Any]) -> dict[str, Any]:
    """The arguments of `make_world` or `load_tracks`, and the options of a kernel among them, by command-line names.

    Raises:
        UserError: an option of no kernel resembles an argument, or is one of the command line's sensors.
    """
    size, known = arguments["size"], OF_TASK | _OF_PLACE
    chances = {
        option: _flat(name, arguments.pop(name, 1.0), size) for name, option in _OF_MISSES.items()
    }
    of_task = {
        known[name]: _flat(name, arguments.pop(name), size) for name in known if name in arguments
    }
    if (coverage := arguments.pop("coverage", None)) is not None:
        # A table has no file; named one, the config leaves the number of sensors, and of prices, to the table.
        file = coverage if _in_memory(coverage) is None else "coverage.npz"
        of_task |= {"sensor": "footprint", "sensor.path": file} | chances
    # The default sensors have no option for a probability of 1.
    elif any(
        isinstance(p, str | Path) or not np.all(np.asarray(p) == 1.0) for p in chances.values()
    ):
        of_task |= {"sensor": "miss"} | chances
    of_kernels = {name for schema in GROUPS["kernel"].values() for name in options(schema)}
    for name in arguments.keys() - of_kernels:
        if name in _OF_SENSORS:
            raise UserError(f"{name}: unknown argument, expected {_OF_SENSORS[name]}")
        if close := difflib.get_close_matches(name, OF_TASK, n=1):
            raise UserError(f"{name}: unknown argument, did you mean {close[0]}?")
    return given(of_task | {f"kernel.{name}": value for name, value in arguments.items()})


def _in_memory(coverage: Any) -> Any:
    """The footprints, unless they are in a file."""
    return None if isinstance(coverage, str | Path) else coverage


def _flat(name: str, value: Any, size: Size) -> Any:
    """An argument `[rows, columns]` as one number for each cell, nan (no sensor) as null; any other as it is.

    Raises:
        UserError: its rows and columns are not those of the grid.
    """
    if not isinstance(value, list | np.ndarray):
        return value
    table = array_of(name, value)
    if table.ndim == 2:
        if (found := table.shape) != (grid := grid_size(size)):
            raise UserError(
                f"{name}: {found[0]} x {found[1]} numbers, expected {grid[0]} x {grid[1]}"
            )
        value = table.ravel()
    if isinstance(value, np.ndarray) and value.dtype.kind == "f" and value.ndim == 1:
        return [None if math.isnan(each) else each for each in value.tolist()]
    return value
