"""Tick labels: none runs into the next, and as many as there is room for."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure as Canvas

from trackmdp.reports.style import draw_figure, tidy
from trackmdp.reports.tables import Column, Table
from trackmdp.reports.ticks import label_values, tick_labels

TABLE = Table("ticks", "", [Column("x")], [[1]])


def drawn(low: float, high: float, scale: str = "log", values: list[float] | None = None) -> Axes:
    """The axes of a figure of the size of a report's, from `low` to `high` on both axes."""
    made: list[Axes] = []

    def paint(figure: Canvas) -> None:
        axes = figure.subplots()
        axes.plot([low, high], [low, high])
        axes.set(xscale=scale, yscale=scale)
        if values:
            label_values(axes, values)
        tidy(axes)
        made.append(axes)

    draw_figure(TABLE, 3.3, paint)
    # The SVG is drawn at another resolution, and sizes of texts are kept from there.
    made[0].figure.draw_without_rendering()  # type: ignore[union-attr]
    return made[0]


def labels(axis: Axis) -> list[str]:
    return [text for tick in axis.get_major_ticks() if (text := tick.label1.get_text())]


def distances(axis: Axis) -> list[float]:
    """Pixels between neighbouring labels; negative where they overlap."""
    boxes = [t.label1.get_window_extent() for t in axis.get_major_ticks() if t.label1.get_text()]
    along = axis is axis.axes.xaxis
    ends = sorted((box.x0, box.x1) if along else (box.y0, box.y1) for box in boxes)
    return [later[0] - sooner[1] for sooner, later in pairwise(ends)]


def test_the_env_steps_of_a_short_run_have_room() -> None:
    """README's first sweep: 10,000 to 300,000."""
    axes = drawn(10_000, 300_000)
    assert labels(axes.xaxis) == ["10k", "20k", "50k", "100k", "200k"]
    assert min(distances(axes.xaxis)) > 5


@settings(max_examples=12, deadline=None)
@given(st.floats(-12, 12), st.floats(0.05, 20))
def test_labels_of_a_logarithmic_axis_never_touch(start: float, decades: float) -> None:
    axes = drawn(10**start, 10 ** (start + decades))
    for axis in (axes.xaxis, axes.yaxis):
        assert len(labels(axis)) >= 2
        assert len(set(labels(axis))) == len(labels(axis))
        assert all(distance >= 0 for distance in distances(axis))


@pytest.mark.parametrize(("high", "least"), [(3.0, 3), (40.0, 3), (1e4, 5), (1e12, 4)])
def test_as_many_labels_as_there_is_room_for(high: float, least: int) -> None:
    assert len(labels(drawn(1.0, high).xaxis)) >= least


def test_prices_close_to_each_other_keep_their_ticks_and_lose_labels() -> None:
    axes = drawn(0.1, 0.245, scale="linear", values=[0.1 + 0.005 * k for k in range(30)])
    assert len(axes.get_xticks()) == 30
    assert 3 <= len(labels(axes.xaxis)) < 15
    assert min(distances(axes.xaxis)) > 5


def test_texts_of_values() -> None:
    assert tick_labels([0.05, 0.1, 300.0]) == ["0.05", "0.1", "300"]
    assert tick_labels([2e3, 1e4, 1e6]) == ["2k", "10k", "1M"]
    assert tick_labels([1e-3, 1.0]) == ["10⁻³", "10⁰"]
    assert tick_labels([1.2e-3, 1.4e-3]) == ["1.2·10⁻³", "1.4·10⁻³"]
