"""The paper's kernel on a small grid."""

from __future__ import annotations

from typing import Any

import numpy as np

from trackmdp.grid.size import Size
from trackmdp.motion.kernels import random_support


def paper(size: Size = 5, **changes: Any) -> np.ndarray:
    options: dict[str, Any] = {
        "support_size": 5,
        "radius": 1,
        "low_probability": 0.15,
        "exit_probability": 0.005,
        "border": "renormalize",
        "seed": 0,
    }
    return random_support(size, **(options | changes)).toarray()
