"""Sensors as a user describes them: the choices of the group `sensor`, as arguments of a `Task`."""

from __future__ import annotations

from typing import Any

import numpy as np

from trackmdp.world.files import per_cell
from trackmdp.world.model import Array, Size

__all__ = ["false_alarm", "miss", "perfect"]


def perfect(size: Size) -> dict[str, Any]:  # noqa: ARG001
    """No sensor misses, which is what a `Task` takes for granted."""
    return {}


def miss(size: Size, *, p_d: float | list[float] | str, p_s: float | list[float] | str) -> dict[str, Any]:
    """p_d of the sensors and p_s of the safe action.

    Raises:
        UserError: a file is missing or malformed, or does not have one probability per cell.
    """
    return {
        "detection": _probabilities("sensor.p_d", p_d, size),
        "safe_detection": _probabilities("sensor.p_s", p_s, size),
    }


def false_alarm(size: Size, *, p_d: float | list[float] | str, p_f: float) -> dict[str, Any]:  # noqa: ARG001
    """p_d of the sensors; p_f is no matter of the task, which policies are made for, but of their evaluation.

    Raises:
        UserError: as `miss`.
    """
    return {"detection": _probabilities("sensor.p_d", p_d, size)}


def _probabilities(key: str, given: float | list[float] | str, size: Size) -> Array:
    expected = "a probability above 0, at most 1"
    return per_cell(key, given, size, lambda p: np.asarray((p > 0) & (p <= 1)), expected)
