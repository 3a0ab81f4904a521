"""Tick labels with room between them: at most five along a figure, seven up an axis."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, TypeAlias

if TYPE_CHECKING:  # an extra, and a second to import
    from matplotlib import axes

Axes: TypeAlias = "axes.Axes"

_ALONG, _UP = 5, 7
# Raised digits as letters: matplotlib's own powers are formulas, which are switched off (`text.parse_math`).
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def label_ticks(axes: Axes) -> None:
    """Round values on logarithmic axes; linear ones keep their ticks."""
    for axis, most in ((axes.xaxis, _ALONG), (axes.yaxis, _UP)):
        low, high = sorted(axis.get_view_interval())
        if axis.get_scale() == "log":
            values = log_ticks(low, high, most)
            axis.set_ticks(values, tick_labels(values))
            axis.set_ticks([], minor=True)


def log_ticks(low: float, high: float, most: int) -> list[float]:
    """Round values from `low` to `high` for a logarithmic axis, at most `most`."""
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    for marks in ((1, 2, 5), (1, 3), (1,)):
        values = [float(f"{mark}e{power}") for power in powers for mark in marks]
        # Limits are powers and sums, which may miss the value of a tick by a rounding error.
        inside = [value for value in values if low * (1 - 1e-9) <= value <= high * (1 + 1e-9)]
        if 3 <= len(inside) <= most:
            return inside
    if high < 10 * low:
        from matplotlib.ticker import MaxNLocator

        return [each for each in MaxNLocator(4).tick_values(low, high) if low <= each <= high]
    return inside[:: math.ceil(len(inside) / most)]


def tick_labels(values: Sequence[float]) -> list[str]:
    """Texts of round values: 0.05, 300, 20k, 1M; powers such as 10⁻³ for small values, and where they span 10⁴."""
    powers = min(values) < 1e-2 or max(values) >= 1e4 * min(values)
    return list(map(_power if powers else _short, values))


def label_values(axes: Axes, values: Sequence[float]) -> None:
    """Ticks of the x axis at rising values; labels at least a fifth of the range apart."""
    least = 0.999 * (values[-1] - values[0]) / (_ALONG - 1)
    texts, last = [], -math.inf
    for value in values:
        texts.append(f"{value:g}" if value - last >= least else "")
        last = value if texts[-1] else last
    axes.set_xticks(values, texts)


def _power(value: float) -> str:
    exponent = math.floor(math.log10(value) + 1e-9)
    factor = f"{value / 10**exponent:.3g}"
    raised = f"10{str(exponent).translate(_RAISED)}"
    return raised if factor == "1" else f"{factor}·{raised}"


def _short(value: float) -> str:
    for unit, letter in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if value >= unit:
            return f"{value / unit:g}{letter}"
    return f"{value:g}"
