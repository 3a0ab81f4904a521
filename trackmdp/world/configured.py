"""From a config to a world or to recorded tracks."""

from __future__ import annotations

import re
from inspect import signature
from typing import Any

from trackmdp.config import WorldConfig
from trackmdp.config.options import options
from trackmdp.config.registry import make, maker
from trackmdp.errors import UserError
from trackmdp.grid.place import Place
from trackmdp.grid.size import TASK_BYTES, Size, check_fits, grid_size
from trackmdp.recordings.track_files import read_track_file
from trackmdp.recordings.tracks import Recorded
from trackmdp.sensing.coverage import Coverage
from trackmdp.world.model import World
from trackmdp.world.problem import Problem

_KERNEL_BYTES = 500
"""Bytes of each cell while a motion kernel is made. Measured on 1,500 x 1,500 cells: random_walk 570, random_support
580, drift 940."""


def make_problem(cfg: WorldConfig, *, frame: Any = None, coverage: Any = None) -> Problem:
    """The world a config describes, or its recorded tracks.

    Args:
        cfg: the config.
        frame: positions as a DataFrame of pandas, in place of the file of `kernel=tracks`.
        coverage: a table of footprints, in place of the file of `sensor=footprint`.

    Raises:
        UserError: the grid does not fit into memory, a file is missing or malformed, or the kernel or a track breaks a
            rule.
    """
    bytes_each = _KERNEL_BYTES if cfg.kernel.is_motion else TASK_BYTES
    check_fits("grid.size", cfg.grid.size, bytes_each)
    if cfg.kernel.is_motion:
        return build_world(cfg, coverage)
    task = of_task(cfg, coverage)
    return make(cfg.kernel, cfg.grid.size, where=cfg.grid.place, frame=frame, **task)


def build_world(cfg: WorldConfig, coverage: Any = None) -> World:
    """The world a config describes; `coverage` as in `make_problem`.

    Raises:
        UserError: a file is missing or malformed, or the kernel breaks a rule (`motion/kernel_checks.py`).
    """
    own = {name: getattr(cfg.kernel, name) for name in options(type(cfg.kernel))}
    modes = {"reveals": own.pop("reveals", False)}
    made = maker(cfg.kernel)(cfg.grid.size, **own)
    if cfg.kernel.hides:
        made, modes["modes"] = made
    task = of_task(cfg, coverage)
    try:
        return World(made, cfg.grid.sides, **task, **modes)
    except UserError as error:  # with the option at fault
        path = own.get("path")
        source = f"kernel={cfg.kernel.name}" if path is None else f"kernel.path={path}"
        raise UserError(re.sub("^kernel(?=:)", lambda _: source, str(error))) from None


def recorded(
    size: Size,
    *,
    path: str,
    format: str | None,
    columns: list[str] | None,
    ends: str,
    starts: str | None,
    held_out: float,
    validation: float,
    seed: int,
    min_length: int | None,
    where: dict[str, Any],
    frame: Any,
    **of_task: Any,
) -> Recorded:
    """The recorded tracks in a file, in their three parts; see `TracksConfig` for the options.

    Raises:
        UserError: the file is missing or malformed, a track is too short, or one of the three parts would be empty.
    """
    gridding = where | {name: of_task.pop(name) for name in ("step", "max_gap")}
    exits = ends == "exit"
    # A located cell, t_max + 1 free choices and the forced step: t_max + 3 cells, the segment that hindsight learns
    # from.
    path_length = of_task["t_max"] + 3
    # A cut track of one cell has no step.
    shortest = max(min_length or path_length, 1 if exits else 2)
    of_task["anywhere"] = None if starts is None else starts == "anywhere"
    (mine, chosen, judged), loaded, place = read_track_file(
        path if frame is None else frame,
        grid_size(size),
        exits,
        shortest,
        format,
        gridding | {"columns": columns},
        (held_out, validation, seed),
    )
    return Recorded(
        mine, size, validation=chosen, held_out=judged, loaded=loaded, place=place, **of_task
    )


def of_task(cfg: WorldConfig, coverage: Any = None) -> dict[str, Any]:
    """Costs and limits of a world config, as arguments of `Task`; `coverage` as in `make_problem`."""
    given = {} if coverage is None else {"table": coverage}
    sensors: dict[str, Any] = make(cfg.sensor, cfg.grid.size, **given)
    count = {}
    if (footprints := Coverage.of(sensors.get("coverage"), cfg.grid.num_cells)) is not None:
        sensors["coverage"] = footprints
        if "sensors" in signature(maker(cfg.cost)).parameters:  # prices per sensor, not per cell
            count = {"sensors": footprints.num_sensors}
    costs: dict[str, Any] = make(cfg.cost, cfg.grid.size, **count)
    limits = {"t_max": cfg.grid.t_max, "max_steps": cfg.grid.max_steps, "window": cfg.grid.window}
    # Recorded tracks come with their place.
    place = {"place": Place.of(**cfg.grid.place)} if cfg.kernel.is_motion else {}
    # The cell, where the command has no options of memory.
    memory = {"memory": cfg.task.memory, "clip": cfg.task.clip} if hasattr(cfg, "task") else {}
    return costs | sensors | limits | place | memory
