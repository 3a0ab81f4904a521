"""From config to objects, in flow order: the one place where names are looked up."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from trackmdp.config import (
    CostConfig,
    DriftConfig,
    KernelConfig,
    PaperCostConfig,
    RandomSupportConfig,
    RandomWalkConfig,
    TableConfig,
    TracksConfig,
    WorldConfig,
)
from trackmdp.errors import UserError
from trackmdp.world import kernels
from trackmdp.world.checks import canonical_kernel, check_kernel
from trackmdp.world.files import read_numbers
from trackmdp.world.model import Array, World
from trackmdp.world.tracks import Problem, Recorded, check_tracks, load_tracks, split

if TYPE_CHECKING:  # the world is built, and a config checked, before anything heavy is imported
    from trackmdp.config import BaselineConfig

__all__ = ["make_baseline", "make_problem", "make_world"]

KERNELS: dict[type[KernelConfig], Callable[..., Array]] = {
    RandomSupportConfig: kernels.random_support,
    RandomWalkConfig: kernels.random_walk,
    DriftConfig: kernels.drift,
    TableConfig: lambda size, *, path: kernels.load_table(path),  # a table has its own size, checked below
}


def make_problem(cfg: WorldConfig) -> Problem:
    """The world a config describes, or its recorded tracks.

    Raises:
        UserError: a file is missing or malformed, or the kernel or a track breaks a rule.
    """
    return _make_recorded(cfg) if isinstance(cfg.kernel, TracksConfig) else make_world(cfg)


def _make_recorded(cfg: WorldConfig) -> Recorded:
    """The recorded tracks a config names, those held out set apart.

    Raises:
        UserError: the file is missing or malformed, a track is too short, or one of the two parts would be empty.
    """
    kernel, size, t_max = cfg.kernel, cfg.grid.size, cfg.grid.t_max
    assert isinstance(kernel, TracksConfig)
    tracks = load_tracks(kernel.path, size, exits=kernel.ends == "exit")
    shortest = max(kernel.min_length or t_max + 3, 1 if kernel.ends == "exit" else 2)  # a cut track of one has no step
    check_tracks(tracks, shortest, f"kernel.path={kernel.path}")
    mine, held_out = split(tracks, kernel.held_out, kernel.seed)
    of_task = _of_task(cfg) | {"markov": kernel.markov, "homogeneous": kernel.homogeneous}
    return Recorded(mine, size, held_out=held_out, anywhere=kernel.starts == "anywhere", **of_task)


def make_world(cfg: WorldConfig) -> World:
    """The world a config describes.

    Raises:
        UserError: a file is missing or malformed, or the kernel breaks a rule (`checks.check_kernel`).
    """
    size = cfg.grid.size
    motion = _values(cfg.kernel)
    homogeneous = motion.pop("homogeneous")
    table = KERNELS[type(cfg.kernel)](size, **motion)
    source = f"kernel.path={cfg.kernel.path}" if isinstance(cfg.kernel, TableConfig) else f"kernel={cfg.kernel.name}"
    kernel = canonical_kernel(table, source)
    check_kernel(kernel, (size, size), truncates=cfg.grid.max_steps is not None, source=source)
    if homogeneous:
        kernels.check_homogeneous(kernel, size, source)
    return World(kernel, size, homogeneous=homogeneous, **_of_task(cfg))


def _of_task(cfg: WorldConfig) -> dict[str, Any]:
    """Costs and limits of a world config, as arguments of `Task`."""
    reward, price, safe = _costs(cfg.cost, cfg.grid.size**2)
    limits = {"t_max": cfg.grid.t_max, "max_steps": cfg.grid.max_steps}
    return {"reward": reward, "cost": price, "safe_cost": safe} | limits


def _values(node: Any) -> dict[str, Any]:
    """The options of one config node as keyword arguments."""
    return {name: getattr(node, name) for name in vars(node)}


def _costs(cost: CostConfig, cells: int) -> tuple[float, Array, float]:
    """r, c `[M]` and D of a cost config."""
    assert isinstance(cost, PaperCostConfig)
    price = _price_per_cell(cost.sensor, cells)
    return cost.reward, price, float(price.sum()) if cost.safe is None else cost.safe


def _price_per_cell(sensor: float | list[float] | str, cells: int) -> Array:
    if not isinstance(sensor, str):
        return np.broadcast_to(np.asarray(sensor, dtype=np.float64), (cells,)).copy()
    price = read_numbers("cost.sensor", sensor, name="cost").ravel()
    if price.size != cells:
        raise UserError(f"cost.sensor={sensor}: {price.size} values, expected {cells} (one per cell)")
    if not (np.isfinite(price) & (price >= 0)).all():
        bad = int(np.flatnonzero(~(np.isfinite(price) & (price >= 0)))[0])
        raise UserError(f"cost.sensor={sensor}: cell {bad} costs {price[bad]}, expected a finite number >= 0")
    return price


def make_baseline(cfg: BaselineConfig, setting: Problem) -> np.ndarray:
    """`[M, t_max+1, M]` chains of a policy that is not learned; probabilities for `random_k`, else bool."""
    from trackmdp import config

    shape = (setting.num_cells, setting.num_choices, setting.num_cells)
    makers: dict[type[Any], Callable[[Any], np.ndarray]] = {
        config.AllOnConfig: lambda c: np.ones(shape, dtype=bool),
        config.NoSensorsConfig: lambda c: np.zeros(shape, dtype=bool),
        config.RandomKConfig: lambda c: np.full(shape, c.k / setting.num_cells),
    }
    if isinstance(setting, World):
        makers |= _planners(setting)
    return makers[type(cfg)](cfg)


def _planners(world: World) -> dict[type[Any], Callable[[Any], np.ndarray]]:
    """The baselines that read the kernel."""
    from trackmdp import config
    from trackmdp.solvers import clocked, fcr, lookahead, myopic, optimal, qmdp

    return {
        config.QmdpConfig: lambda c: qmdp.solve(world, in_grid=c.in_grid),
        config.MyopicConfig: lambda c: myopic.solve(world, threshold=c.threshold),
        config.ClockedConfig: lambda c: clocked.solve(world),
        config.FcrConfig: lambda c: fcr.solve(world, in_grid=c.in_grid),
        config.LookaheadConfig: lambda c: lookahead.solve(world, depth=c.depth, tail=c.tail),
        config.OptimalConfig: lambda c: optimal.solve(world, time_limit=c.time_limit, tolerance=c.tolerance).chains,
    }
