"""Names at the ends of lines; the figure that explains the idea, by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.axes import Axes
from scipy import sparse

from trackmdp.reports.idea import idea_figure, scenes
from trackmdp.reports.labels import label_lines, spread
from trackmdp.reports.results import MotionTable, Sensed
from trackmdp.reports.style import LOOKS, canvas, looks_of


def test_labels_make_room_for_each_other() -> None:
    """Two at .5, each .1 tall, one far below; two that want to be above the top are kept inside."""
    np.testing.assert_allclose(spread([0.5, 0.5, 0.1], np.full(3, 0.1)), [0.55, 0.45, 0.1])
    np.testing.assert_allclose(spread([1.0, 1.0], np.full(2, 0.1)), [0.95, 0.85])
    assert spread([], np.zeros(0)).tolist() == []


@given(st.lists(st.tuples(st.floats(0, 1), st.floats(0.02, 0.1)), min_size=1, max_size=9))
def test_labels_never_overlap_nor_change_their_order(ends: list[tuple[float, float]]) -> None:
    wanted, tall = np.array(sorted(ends, reverse=True)).T
    found = spread(wanted.tolist(), tall)
    assert (found[:-1] - found[1:] >= (tall[:-1] + tall[1:]) / 2 - 1e-9).all()
    assert found[0] + tall[0] / 2 <= 1 + 1e-9
    assert found[-1] - tall[-1] / 2 >= -1e-9


def written(draw: list[tuple[str, list[float]]], first: list[str]) -> tuple[list[str], Axes]:
    with canvas(3.4, "here") as figure:
        axes = figure.subplots()
        for name, values in draw:
            axes.plot([1, 2, 3], values, label=name)
        axes.set_ylim(0, 10)
        label_lines(figure, [axes], first=first)
        figure.draw_without_rendering()
        assert bool(figure.legends) != bool(axes.texts)
        return [text.get_text() for text in axes.texts], axes


def test_lines_that_coincide_are_named_together_and_the_learned_one_first() -> None:
    lines = [("optimum", [1.0, 5.0, 9.0]), ("other", [1.0, 4.0, 9.0]), ("ppo", [1.01, 5.01, 9.01]), ("dqn", [1.0] * 3)]
    assert written(lines, ["ppo", "dqn"])[0] == ["ppo", "= optimum", "other", "dqn"]


def test_a_long_name_is_broken_and_too_many_lines_have_a_legend() -> None:
    (long,), _ = written([("gamma=0.9 blend.until=0.3", [1.0, 2.0, 3.0])], [])
    assert max(map(len, long.splitlines())) <= 20
    assert len(long.splitlines()) == 2
    assert written([(f"line {k}", [0.0, 0.0, k / 3]) for k in range(30)], [])[0] == []


@pytest.mark.parametrize("others", [1, 5, 9])
def test_no_two_series_have_one_colour(others: int) -> None:
    bounds = [name for name in LOOKS if name.endswith("bound") or name in ("Q_MDP", "optimum")]
    labels = ["hindsight", "a2c", *(f"hindsight {k}" for k in range(min(others, 7))), *bounds]
    colours = [look.colour for look in looks_of(labels).values()]
    assert len(set(colours)) == len(labels)


def line_of_four(second: list[bool]) -> tuple[Sensed, MotionTable]:
    """A target that goes from 0 to 1 (.6) or 2 (.4), from 2 to 3; first the sensor of 1 is on, then those `second`."""
    kernel = np.zeros((4, 4))
    kernel[0, 1], kernel[0, 2], kernel[1, 1], kernel[2, 3], kernel[3, 3] = 0.6, 0.4, 0.9, 0.9, 0.9
    chains = np.zeros((4, 2, 4), dtype=bool)
    chains[:, 0] = kernel > 0
    chains[0, 0], chains[0, 1] = [False, True, False, False], second
    zeros = np.zeros(4)
    return Sensed(sparse.csr_array(chains.reshape(8, 4)), zeros), MotionTable(sparse.csr_array(kernel), zeros, zeros)


def test_the_idea_is_a_miss_that_is_made_good() -> None:
    policy, motion = line_of_four([False, False, False, True])
    located, missed, told, found = scenes(policy, motion)
    assert (located.target, located.found) == (0, True)
    assert missed.belief.tolist() == [0, 0.6, 0.4, 0]
    assert (missed.target, missed.found, missed.on.tolist()) == (2, False, [False, True, False, False])
    assert (told.target, told.belief.tolist()) == (None, [0, 0, 1, 0])
    assert found.belief == pytest.approx([0, 0, 0, 0.9])
    assert (found.target, found.found) == (3, True)
    figure = idea_figure(policy, motion, (1, 4), "here")
    assert figure
    assert figure.table.rows[1] == ["2  moves; missed", 1, 2, 0.6, True]


def test_where_no_miss_can_be_made_good_there_is_no_such_figure() -> None:
    assert idea_figure(*line_of_four([True, True, True, False]), (1, 4), "here") is None
    policy, motion = line_of_four([False] * 4)
    assert scenes(Sensed(policy.on(0), policy.value), motion) == []
