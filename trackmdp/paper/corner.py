"""Worlds of four cells, in which all plans, histories and beliefs can be listed."""

from __future__ import annotations

import numpy as np

from trackmdp.world.model import World

SIDE = 2


def corner(world: World) -> World:
    """The top left 2 x 2 cells, or fewer, with their modes; leaving them is exiting. T_max is at most 2; no window.

    The value is undiscounted, and finite only where the target exits: rows above .99 are scaled to .99. The price D of
    the safe action shrinks with the number of cells, as the sum of all prices does.
    """
    rows, columns = (min(SIDE, side) for side in world.size)
    row, column = np.divmod(np.arange(rows * columns), columns)
    cells = row * world.columns + column
    states = (cells[:, None] * world.modes + np.arange(world.modes)).ravel()
    kernel = world.kernel[states][:, states].toarray()
    kernel *= 0.99 / np.maximum(kernel.sum(axis=1, keepdims=True), 0.99)
    given = world.given | {
        "size": (rows, columns),
        "t_max": min(world.t_max, 2),
        "max_steps": None,
        "window": None,
        "safe_cost": world.safe_cost * len(cells) / world.num_cells,
        "memory": "cell",
    }
    for name in ("cost", "detection", "safe_detection"):
        given[name] = getattr(world, name)[cells]
    return World(kernel, modes=world.modes, **given)


def dearer(world: World) -> World:
    """The world with sensors a little dearer than the likeliest move is worth.

    Above r max P no sensor earns its price by the next reward alone: misses happen, beliefs spread, the clock runs on.
    """
    cost = np.maximum(world.cost, 1.05 * world.reward * float(world.kernel.max()))
    return world.but(cost=cost, safe_cost=max(world.safe_cost, float(cost.sum())))
