"""The worlds of the paper's experiments (Section VII)."""

from __future__ import annotations

import numpy as np

from trackmdp.world.kernels import Border, random_support
from trackmdp.world.model import Array, World

SUPPORTS = (3, 4, 5)
"""Z, the positions that the target may move to from a cell."""
COSTS = (0.16, 0.18, 0.2, 0.22)
"""c, the price of a sensor for one step."""
SIZE, REWARD = 10, 1.0
"""N, and r."""
RADIUS, LOW_PROBABILITY, EXIT_PROBABILITY = 1, 0.15, 0.005
"""Of the motion; T_max, the border rule and the draw of the kernel the paper does not say."""


def paper_kernel(support_size: int, seed: int, border: Border) -> Array:
    """`[100, 100]` one draw of the paper's kernel with Z = `support_size`."""
    return random_support(
        SIZE,
        support_size=support_size,
        radius=RADIUS,
        low_probability=LOW_PROBABILITY,
        exit_probability=EXIT_PROBABILITY,
        border=border,
        seed=seed,
    )


def paper_world(kernel: Array, cost: float, t_max: int) -> World:
    """The paper's world with this kernel `[100, 100]`: the safe action costs as much as all sensors, D = N² c."""
    m = SIZE**2
    return World(kernel, SIZE, cost=np.full(m, cost), safe_cost=m * cost, t_max=t_max, reward=REWARD)
