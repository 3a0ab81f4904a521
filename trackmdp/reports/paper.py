"""The paper's experiments (Section VII): its worlds, and the numbers it prints."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from trackmdp.reports.grouping import Study
from trackmdp.reports.results import Run
from trackmdp.world.kernels import Border, random_support
from trackmdp.world.model import Array, World

__all__ = ["COSTS", "PRINTED_QMDP", "PRINTED_TMDP", "SUPPORTS", "draw_kernel", "pair_of", "pairs", "world_of"]

SUPPORTS = (3, 4, 5)
COSTS = (0.16, 0.18, 0.2, 0.22)

PRINTED_QMDP: Mapping[tuple[int, float], float] = {
    **{(3, c): 90.74 for c in COSTS},
    **{(4, c): 88.82 for c in COSTS},
    **{(5, c): 89.95 for c in COSTS[:3]},
    (5, 0.22): 54.3,
}
"""Table II, accuracy of Q_MDP in per cent, by (Z, c)."""

PRINTED_TMDP: Mapping[tuple[int, float], float] = {
    **dict(zip([(3, c) for c in COSTS], (92.39, 92.06, 93.23, 87.18), strict=True)),
    **dict(zip([(4, c) for c in COSTS], (94.28, 95.56, 89.7, 88.85), strict=True)),
    **dict(zip([(5, c) for c in COSTS], (93.75, 94.94, 92.45, 90.21), strict=True)),
}
"""Table II, accuracy of the paper's learned policy in per cent, by (Z, c)."""

_FIXED = {
    "grid.size": 10,
    "grid.max_steps": None,
    "kernel.name": "random_support",
    "kernel.radius": 1,
    "kernel.low_probability": 0.15,
    "kernel.exit_probability": 0.005,
    "cost.reward": 1,
    "cost.safe": None,
}
"""What the paper says of its worlds; T_max, the border rule and the draw of the kernel it does not."""


def draw_kernel(support_size: int, seed: int, border: Border) -> Array:
    """`[100, 100]` one draw of the paper's kernel with Z = `support_size`."""
    return random_support(
        10,
        support_size=support_size,
        radius=1,
        low_probability=0.15,
        exit_probability=0.005,
        border=border,
        seed=seed,
    )


def world_of(kernel: Array, cost: float, t_max: int) -> World:
    """The paper's world with this kernel: N = 10, r = 1, D = N² c."""
    return World(10, 1.0, np.full(100, cost), 100 * cost, t_max, kernel)


def pair_of(settings: Mapping[str, Any]) -> tuple[int, float] | None:
    """(Z, c) of a run in one of the paper's worlds, else None."""
    if any(settings.get(key) != value for key, value in _FIXED.items()):
        return None
    pair = settings.get("kernel.support_size"), settings.get("cost.sensor")
    return pair if pair in PRINTED_QMDP else None  # type: ignore[return-value]


def pairs(study: Study) -> dict[tuple[int, float], str]:
    """The paper's (Z, c) -> the label of the world that stands for it, in the order of the figures.

    Where several do (other T_max, border or kernel), it is the one with most runs.
    """
    found: dict[tuple[int, float], str] = {}
    for world in study.worlds:
        runs: list[Run] = study.in_world(world)
        pair = pair_of(runs[0].settings)
        if pair is not None and (pair not in found or len(study.in_world(found[pair])) < len(runs)):
            found[pair] = world
    return dict(sorted(found.items()))
