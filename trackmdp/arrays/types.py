"""Types of arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
Indices = npt.NDArray[np.int64]
IndexArray = npt.NDArray[np.integer[Any]]
"""Of whole numbers of any width."""
AnyArray = npt.NDArray[Any]
