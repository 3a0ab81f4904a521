"""From names and options, or from a config, to a world or to recorded tracks; and what the group `sensor` offers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from inspect import signature
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from trackmdp.config import WorldConfig
from trackmdp.config.compose import compose, default, given
from trackmdp.config.options import options, refuse
from trackmdp.config.registry import make, maker
from trackmdp.config.sensing import lattice
from trackmdp.errors import UserError
from trackmdp.world.checks import PRICES, PROBABILITIES, canonical_kernel, check_kernel
from trackmdp.world.coverage import Coverage, discs
from trackmdp.world.files import per_cell, read_matrix
from trackmdp.world.model import Size, World, grid_size
from trackmdp.world.modes import HiddenWorld, Modelled
from trackmdp.world.track_files import read_recording, read_track_file
from trackmdp.world.tracks import Problem, Recorded, split

_OF_TASK = {
    "size": "grid.size",
    "t_max": "grid.t_max",
    "max_steps": "grid.max_steps",
    "window": "grid.window",
    "cost": "cost.sensor",
    "safe_cost": "cost.safe",
    "reward": "cost.reward",
    "memory": "task.memory",
    "clip": "task.clip",
}
"""Arguments of `make_world` and `load_tracks` -> options of the command line."""


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
    detection: npt.ArrayLike | str = 1.0,
    safe_detection: npt.ArrayLike | str = 1.0,
    memory: str = default("task.memory"),
    clip: int = default("task.clip"),
    **kernel_options: Any,
) -> Modelled:
    """A world with one of the motion kernels; for a table of your own take `World` itself.

    The defaults are those of `conf/`, and the checks those of the command line.

    Args:
        kernel: name of the kernel, as in ``trackmdp solve kernel=...``: ``random_support``, ``random_walk``, ``drift``,
            ``table``, or one of an installed plugin; for targets with a mode, such as a heading or a velocity,
            ``heading``, ``regimes``, ``constant_velocity`` or ``coordinated_turn``.
        size: N of an N x N grid, or (rows, columns).
        t_max: T_max; the controller chooses freely at n = 0 ... t_max.
        cost: c, the price of one sensor for one step; one number, one per cell, or a file.
        safe_cost: D; None: the sum of all sensors' prices.
        reward: r, earned by a detection.
        max_steps: episodes are truncated after so many steps; None: never.
        window: W; only sensors up to W rows and columns from the last located cell can be chosen. None: all can.
        detection: p_d, how likely a sensor that is on reports the target in its cell; as `cost`, in (0, 1].
        safe_detection: p_s, the same of the safe action, which is repeated until it locates; as `detection`.
        memory: what a policy remembers at a detection, as in `load_tracks`; the cell, unless targets have a mode.
        clip: rows and columns up to which displacements are told apart.
        **kernel_options: the kernel's own, such as ``support_size=5`` (``trackmdp solve --help`` lists them), or
            ``reveals=True`` where detections tell the mode.

    Returns:
        A `World`, or a `HiddenWorld` where targets have a mode.

    Raises:
        UserError: a name, a type or a range is wrong, or the kernel breaks a rule.

    Example:
        >>> make_world("drift", size=5, direction=90).num_cells
        25
        >>> make_world("heading", size=4, reveals=True).num_keys
        128
    """
    made = make_problem(compose("solve", given({"kernel": kernel}) | _words(locals(), kernel_options)))
    assert not isinstance(made, Recorded)  # there is nothing to solve for
    return made


def load_tracks(
    path: str | Path,
    size: Size = default("grid.size"),
    *,
    t_max: int = default("grid.t_max"),
    cost: npt.ArrayLike | str = default("cost.sensor"),
    safe_cost: float | None = default("cost.safe"),
    reward: float = default("cost.reward"),
    max_steps: int | None = default("grid.max_steps"),
    window: int | None = default("grid.window"),
    detection: npt.ArrayLike | str = 1.0,
    safe_detection: npt.ArrayLike | str = 1.0,
    memory: str = default("task.memory"),
    clip: int = default("task.clip"),
    **track_options: Any,
) -> Recorded:
    """Recorded tracks in place of a motion model: most to learn from, some to choose by, some held out to evaluate on.

    Args:
        path: a file of cells (.csv or .npz with columns track, cell, or row and column, and, if wanted, step), or one
            of positions: a table (.csv, .parquet) of id, time and x, y or lat, lon, as of AIS and ADS-B; GeoJSON; GPX;
            MOT-Challenge text; SUMO's fcd-output. Positions need `step` and `cell`; see `Recorded.loaded` for what
            was left out.
        size: N of an N x N grid, or (rows, columns).
        t_max: see `make_world`, as for the following.
        cost: c.
        safe_cost: D.
        reward: r.
        max_steps: tracks are cut after so many steps; None: never.
        window: W.
        detection: p_d.
        safe_detection: p_s.
        memory: what a policy remembers at a detection: ``cell``, ``displacement``, ``displacement_gap`` or
            ``two_displacements``.
        clip: rows and columns up to which displacements are told apart.
        **track_options: those of ``kernel=tracks`` (``trackmdp train kernel=tracks --help``): `format`, `step`, `cell`,
            `max_gap`, `origin`, `crs`, `ends`, `starts`, `held_out`, `validation`, `seed`, `min_length`, `markov`.

    Raises:
        UserError: the file is not of that form, a track is too short, or an option is wrong.

    Example:
        ``load_tracks("ais.csv", (40, 60), cell=500, step=60, max_gap=600, ends="cut")``
    """
    # Of the options of `train` only those of the problem matter; the algorithm is one that may remember anything.
    words = {"kernel": "tracks", "kernel.path": path, "algo": "path_counts"} | _words(locals(), track_options)
    made = make_problem(compose("train", words))
    assert isinstance(made, Recorded)
    return made


def make_problem(cfg: WorldConfig) -> Problem:
    """The world a config describes, or its recorded tracks.

    Raises:
        UserError: a file is missing or malformed, or the kernel or a track breaks a rule.
    """
    if cfg.kernel.hides:
        return _hidden(cfg)
    if cfg.kernel.is_motion:
        return build_world(cfg)
    return make(cfg.kernel, cfg.grid.size, **of_task(cfg))


def _hidden(cfg: WorldConfig) -> HiddenWorld:
    """The world of a target with a mode, which a detection tells where `kernel.reveals` says so."""
    own = {name: getattr(cfg.kernel, name) for name in options(type(cfg.kernel))}
    reveals = own.pop("reveals")
    kernel, modes = maker(cfg.kernel)(cfg.grid.size, **own)
    return HiddenWorld(kernel, cfg.grid.size, modes=modes, **of_task(cfg), revealed=modes if reveals else 1)


def build_world(cfg: WorldConfig) -> World:
    """The world a config describes.

    Raises:
        UserError: a file is missing or malformed, or the kernel breaks a rule (`checks.check_kernel`).
    """
    if cfg.kernel.hides:
        raise refuse("kernel", cfg.kernel.name, "a kernel without a hidden mode")
    size, source = cfg.grid.sides, cfg.kernel.source
    # `World` checks again; here the message names the option at fault (`source`).
    kernel = canonical_kernel(make(cfg.kernel, cfg.grid.size), source)
    check_kernel(kernel, size, truncates=cfg.grid.max_steps is not None, source=source)
    return World(kernel, size, **of_task(cfg))


def recorded(
    size: Size,
    *,
    path: str,
    format: str | None,
    ends: str,
    starts: str,
    held_out: float,
    validation: float,
    seed: int,
    min_length: int | None,
    markov: bool,
    **others: Any,
) -> Recorded:
    """The recorded tracks in a file, in their three parts; see `TracksConfig` for the options.

    A `recording.npz`, which a run keeps of tracks that were in memory, has the parts and the ends of its own.

    Raises:
        UserError: the file is missing or malformed, a track is too short, or one of the three parts would be empty.
    """
    gridding = {name: others.pop(name) for name in ("step", "cell", "max_gap", "origin", "crs")}
    of_task = others | {"markov": markov, "anywhere": starts == "anywhere"}
    if (kept := read_recording(path, math.prod(grid_size(size)))) is not None:
        return Recorded(kept[0], size, validation=kept[1], held_out=kept[2], **of_task)
    # A located cell, t_max + 1 free choices and the forced step: t_max + 3 cells, the segment that hindsight learns
    # from.
    shortest = max(min_length or of_task["t_max"] + 3, 1 if ends == "exit" else 2)  # a cut track of one has no step
    tracks, loaded = read_track_file(path, grid_size(size), ends == "exit", shortest, format, gridding)
    mine, chosen, judged = split(tracks, held_out, validation, seed)
    return Recorded(mine, size, validation=chosen, held_out=judged, loaded=loaded, **of_task)


def paper_cost(
    size: Size, *, reward: float, sensor: float | list[float] | str, safe: float | None, sensors: int | None = None
) -> dict[str, Any]:
    """r, c and D as arguments of `Task`; `sensors` is their number where there is not one in each cell.

    Raises:
        UserError: a file of prices is missing or malformed, or does not have one price per sensor.
    """
    return {"reward": reward, "cost": per_cell("cost.sensor", sensor, size, PRICES, sensors), "safe_cost": safe}


def _words(arguments: Mapping[str, Any], options: Mapping[str, Any]) -> dict[str, Any]:
    """What was given to `make_world` or `load_tracks`, and the kernel's own `options`, by the command line's names."""
    of_task = {option: arguments[name] for name, option in _OF_TASK.items()}
    own = {f"kernel.{name}": value for name, value in options.items()}
    return given(of_task | sensor_words(arguments["detection"], arguments["safe_detection"]) | own)


def sensor_words(detection: Any, safe_detection: Any) -> dict[str, Any]:
    """p_d and p_s by the names of the command line; nothing where all are 1, so that no sensor misses."""
    if all(not isinstance(p, (str, Path)) and np.all(np.asarray(p) == 1.0) for p in (detection, safe_detection)):
        return {}
    return {"sensor": "miss", "sensor.p_d": detection, "sensor.p_s": safe_detection}


def of_task(cfg: WorldConfig) -> dict[str, Any]:
    """Costs and limits of a world config, as arguments of `Task`."""
    sensors: dict[str, Any] = make(cfg.sensor, cfg.grid.size)
    # Prices per sensor: how many those are is told to costs that ask for it.
    told = {}
    if (coverage := sensors.get("coverage")) is not None and "sensors" in signature(maker(cfg.cost)).parameters:
        told = {"sensors": coverage.num_sensors}
    costs: dict[str, Any] = make(cfg.cost, cfg.grid.size, **told)
    limits = {"t_max": cfg.grid.t_max, "max_steps": cfg.grid.max_steps, "window": cfg.grid.window}
    return costs | sensors | limits | cfg.remembered


def perfect(size: Size) -> dict[str, Any]:  # noqa: ARG001
    """No sensor misses, which is what a `Task` takes for granted."""
    return {}


def miss(size: Size, *, p_d: float | list[float] | str, p_s: float | list[float] | str) -> dict[str, Any]:
    """p_d of the sensors and p_s of the safe action.

    Raises:
        UserError: a file is missing or malformed, or does not have one probability per cell.
    """
    return {
        "detection": per_cell("sensor.p_d", p_d, size, PROBABILITIES),
        "safe_detection": per_cell("sensor.p_s", p_s, size, PROBABILITIES),
    }


def false_alarm(size: Size, *, p_d: float | list[float] | str, p_f: float) -> dict[str, Any]:  # noqa: ARG001
    """p_d of the sensors; p_f is no matter of the task, which policies are made for, but of their evaluation.

    Raises:
        UserError: as `miss`.
    """
    return {"detection": per_cell("sensor.p_d", p_d, size, PROBABILITIES)}


def footprint(size: Size, *, radius: float, spacing: int, path: str | None) -> dict[str, Any]:
    """Discs of `radius` around the places of a lattice, or the footprints in a file.

    Raises:
        UserError: the file is missing or malformed, or holds no footprints on this grid.
    """
    rows, columns = grid_size(size)
    if path is not None:
        table = read_matrix("sensor.path", path, name="coverage")
        try:
            return {"coverage": Coverage.of(table, rows * columns)}
        except UserError as error:  # the option at fault is told with it
            raise UserError(f"sensor.path={path}: {str(error).removeprefix('coverage: ')}") from error
    places = np.stack(np.meshgrid(lattice(rows, spacing), lattice(columns, spacing), indexing="ij"), axis=-1)
    return {"coverage": Coverage.of(discs((rows, columns), places.reshape(-1, 2), radius), rows * columns)}
