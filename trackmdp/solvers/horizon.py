"""Exact figures of episodes that are truncated after `max_steps` steps.

Values then depend on the steps left, so the linear solve becomes a backward recursion over them. Nothing diverges where
the target never exits.
"""

from __future__ import annotations

import numpy as np

from trackmdp.policies.table import PolicyTable
from trackmdp.solvers.evaluation import Evaluation, pooled
from trackmdp.solvers.prediction import renewal
from trackmdp.world.model import World


def truncated_value(world: World, policy: PolicyTable, max_steps: int) -> Evaluation:
    """The figures of `evaluate` for episodes of at most `max_steps` steps.

    With h steps left, V_h = Σ_t [b_t + L_t V_{h-t}] over the steps t = 1 ... min(h, t_max + 2) after a detection:
    b_t is gathered at step t, and L_t says where the target is located at step t. Kept are the last t_max + 2 V_h.
    """
    steps = list(renewal(world, policy))
    left = [np.zeros_like(steps[0][1])]  # V_{h-1}, V_{h-2}, ...
    for h in range(1, max_steps + 1):
        # zip stops at the shorter one: with h steps left only the first h steps of a renewal happen.
        now = sum(earned + hit @ later for (hit, earned), later in zip(steps[:h], left, strict=False))
        # V_h is made of the t_max + 2 before it alone: where it is the same as they are, to the last bit, so are all
        # that follow.
        if len(left) == len(steps) and all(np.array_equal(now, later) for later in left):
            break
        left = [np.asarray(now), *left[: len(steps) - 1]]
    return pooled(left[0][: world.num_cells].T)
