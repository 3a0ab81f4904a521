"""The policy of a fixed rule or a solver, as a dense array."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from trackmdp.config.registry import make
from trackmdp.world.tracks import Problem

if TYPE_CHECKING:  # the world is built, and a config checked, before anything heavy is imported
    from trackmdp.config import BaselineConfig

__all__ = ["make_baseline"]


def make_baseline(cfg: BaselineConfig, setting: Problem) -> np.ndarray:
    """`[M, t_max+1, M]` chains of a policy that is not learned; probabilities for `random_k`, else bool."""
    from trackmdp.solvers.solution import Solution

    made: Any = make(cfg, setting)
    if isinstance(made, Solution):
        return made.table.dense()
    if getattr(made, "probability", None) is None:
        dense: np.ndarray = made.dense()
        return dense
    value = bool(made.probability) if made.deterministic else made.probability
    return np.full((setting.num_cells, setting.num_choices, setting.num_cells), value)
