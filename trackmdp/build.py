"""From config to objects, in flow order: the one place where names are looked up."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from trackmdp.world.model import World
from trackmdp.world.tracks import Problem

if TYPE_CHECKING:  # the world is built, and a config checked, before anything heavy is imported
    from trackmdp.config import BaselineConfig

__all__ = ["make_baseline"]


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
        config.QmdpConfig: lambda c: qmdp.solve(world, in_grid=c.in_grid).dense(),
        config.MyopicConfig: lambda c: myopic.solve(world, threshold=c.threshold).dense(),
        config.ClockedConfig: lambda c: clocked.solve(world).dense(),
        config.FcrConfig: lambda c: fcr.solve(world, in_grid=c.in_grid).dense(),
        config.LookaheadConfig: lambda c: lookahead.solve(world, depth=c.depth, tail=c.tail).dense(),
        config.OptimalConfig: lambda c: optimal.solve(
            world, time_limit=c.time_limit, tolerance=c.tolerance
        ).table.dense(),
    }
