"""Figures of accuracy against sensors per step: of a frontier, and of the policies of a sweep over prices."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import fmean
from typing import Any, NamedTuple

import numpy as np

from trackmdp.notebook.card import counted_words
from trackmdp.reports.figures import Panel, slug
from trackmdp.reports.grouping import Study
from trackmdp.reports.style import (
    BLUE,
    INK,
    REFERENCES,
    VERMILION,
    Axes,
    Canvas,
    Figure,
    draw_figure,
    legend,
    looks_of,
    tidy,
)
from trackmdp.reports.tables import Column, Rows, Table
from trackmdp.solvers.tradeoff import Mixture, Tradeoff, upper_hull

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
    title = "Accuracy against sensors per step"
    table = Table("frontier", title, [*columns, Column("net accuracy", 4)], rows)
    return draw_figure(table, 0.9 + 1.7 * len(parts), paint)


def _draw(axes: Axes, found: Tradeoff, asked: Mapping[str, Mixture], name: str) -> None:
    """Corners, the edges between them on which mixtures lie, and the mixtures asked for."""
    corners = found.corners
    heights = [getattr(corner, name) for corner in corners]
    marker = "o" if len(corners) <= _CORNERS else ""
    sensors = [corner.sensors for corner in corners]
    axes.plot(sensors, heights, color=INK, marker=marker, label="policies")
    for key, mixture in asked.items():
        marker = "D" if key == "accuracy" else "s"
        point = (mixture.sensors, getattr(mixture, name))
        label = f"{key}={getattr(mixture, key):.4g}"
        axes.plot(*point, color=VERMILION, marker=marker, ls="", label=label)


class _Place(NamedTuple):
    """A policy at a price; `net` is its accuracy."""

    price: float
    sensors: float
    net: float


_PLANE = ("sensors_per_step", "accuracy")


def swept_figure(study: Study, panel: Panel) -> Figure | None:
    """Learned policies at all prices over the frontier of the solver's; None where accuracy or sensors are unknown.

    The frontier is the hull of the best policies known: a mixture of two neighbours attains each of its points. A
    policy may lie above it, as D is paid as well.
    """
    title, worlds = panel
    learned = {
        method: places for method in study.methods if (places := _learned(study, worlds, method))
    }
    best = [
        _Place(price, *(study.reference(world, "best known", key) for key in _PLANE))
        for price, world in worlds.items()
    ]
    best = [each for each in best if np.isfinite(each).all()]
    hull, name = upper_hull(best), study.title("best known")

    def paint(figure: Canvas) -> None:
        axes = figure.subplots()
        if best:
            _points(axes, hull, vars(REFERENCES["best known"]) | {"label": name})
        # Also those below the line, which a mixture of their neighbours beats.
        _points(axes, best, {"color": INK, "marker": "+", "linestyle": ""})
        looks = looks_of(study.methods)
        for method, places in learned.items():
            _points(axes, places, vars(looks[method]) | {"linestyle": "", "label": method})
        axes.set(xlabel="sensors per step", ylabel="accuracy")
        tidy(axes)
        legend(figure, axes)

    rows: Rows = [[name, *each, each in hull, None] for each in best]
    counts = [0]
    for method, places in learned.items():
        seeds = [len(study.of(worlds[each.price], method)) for each in places]
        rows += [[method, *each, None, n] for each, n in zip(places, seeds, strict=True)]
        counts += seeds
    line = f"; line: mixtures of two policies, {name}" if best else ""  # none on recordings
    most = counted_words(max(counts), "seed")
    caption = f"Accuracy against sensors per step at all prices, {title}{line}; n = {most}"
    columns = [Column("policy"), Column("c"), Column("sensors per step", 3)]
    columns += [Column("accuracy", 4), Column("on the line"), Column("n")]
    table = Table(f"frontier-{slug(title)}", caption, columns, rows)
    return draw_figure(table, 3.4, paint) if max(counts) else None


def _learned(study: Study, worlds: Mapping[float, str], method: str) -> list[_Place]:
    """Means over seeds at each price."""
    found = []
    for price, world in worlds.items():
        sensors, accuracy = (study.values(world, method, key) for key in _PLANE)
        if sensors and accuracy:
            # Means of both are what a run drawn at random attains: all have the same expected steps.
            found.append(_Place(price, fmean(sensors), fmean(accuracy)))
    return found


def _points(axes: Axes, places: Sequence[_Place], look: Mapping[str, Any]) -> None:
    axes.plot([each.sensors for each in places], [each.net for each in places], **look)
