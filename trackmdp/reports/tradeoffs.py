"""Figure of a frontier: accuracy against sensors per step and, where D is paid, the net accuracy below it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from trackmdp.reports.style import (
    BLUE,
    INK,
    VERMILION,
    Axes,
    Canvas,
    Figure,
    draw_figure,
    legend,
    tidy,
)
from trackmdp.reports.tables import Column, Table
from trackmdp.solvers.tradeoff import Mixture, Tradeoff

_SEEN = 0.005
"""Gap from which the bound is drawn: a closer one lies on the line."""
_CORNERS = 30
"""Most corners with a marker: more would hide the line."""


def tradeoff_figure(found: Tradeoff, asked: Mapping[str, Mixture]) -> Figure:
    """A line through the corners, the proved bound where it lies above them, and the mixtures asked for."""
    parts = {"accuracy": "accuracy"} | ({"net accuracy": "net"} if found.safe_cost else {})

    def paint(figure: Canvas) -> None:
        drawn = figure.subplots(len(parts), 1, sharex=True, squeeze=False)[:, 0]
        for axes, (label, name) in zip(drawn, parts.items(), strict=True):
            _draw(axes, found, asked, name)
            axes.set_ylabel(label)
            tidy(axes)
        # The bound is on the net accuracy, the last part.
        if found.gap > _SEEN:
            sensors = np.linspace(found.corners[0].sensors, found.corners[-1].sensors, 200)
            heights = [min(1.0, found.bound(each)) for each in sensors]
            drawn[-1].plot(sensors, heights, color=BLUE, ls="-.", label="bound on all policies")
        drawn[-1].set_xlabel("sensors per step" if found.equal_prices else "sensors by price")
        legend(figure, drawn[-1])

    columns = [Column("price"), Column("sensors per step", 4), Column("accuracy", 4)]
    rows = [[each.price, each.sensors, each.accuracy, each.net] for each in found.corners]
    table = Table(
        "frontier", "Corners of the frontier", [*columns, Column("net accuracy", 4)], rows
    )
    return draw_figure("Accuracy against sensors per step", table, 0.9 + 1.7 * len(parts), paint)


def _draw(axes: Axes, found: Tradeoff, asked: Mapping[str, Mixture], name: str) -> None:
    """Corners, the edges between them on which mixtures lie, and the mixtures asked for."""
    corners = found.corners
    heights = [getattr(corner, name) for corner in corners]
    marker = "o" if len(corners) <= _CORNERS else ""
    sensors = [corner.sensors for corner in corners]
    axes.plot(sensors, heights, color=INK, marker=marker, label="policies")
    for key, mixture in asked.items():
        marker = "D" if key == "accuracy" else "s"
        point, label = (
            (mixture.sensors, getattr(mixture, name)),
            f"{key}={getattr(mixture, key):.4g}",
        )
        axes.plot(*point, color=VERMILION, marker=marker, ls="", label=label)
