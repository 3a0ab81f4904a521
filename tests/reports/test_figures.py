"""Figures: their numbers, their words, and the same bytes each time."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy import sparse

from tests.reports.sweeps import write_sweep
from trackmdp.app.cli import main
from trackmdp.reports import figures, maps
from trackmdp.reports.figures import Panel
from trackmdp.reports.gather import gather_runs
from trackmdp.reports.grouping import Study, study
from trackmdp.reports.results import MotionTable, Results, Sensed
from trackmdp.reports.style import draw_figure
from trackmdp.reports.tables import Column, Table


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Results:
    return gather_runs(write_sweep(tmp_path_factory.mktemp("sweep")))


@pytest.fixture(scope="module")
def grouped(results: Results) -> Study:
    return study(results.runs)


@pytest.fixture(scope="module")
def panel(grouped: Study) -> Panel:
    (panel,) = figures.panels(grouped)
    return panel


def test_worlds_that_differ_in_price_make_a_panel(panel: Panel) -> None:
    assert (panel.title, panel.costs) == ("Z=5", [0.16, 0.22])
    assert panel.worlds == ["Z=5, c=0.16", "Z=5, c=0.22"]


@pytest.mark.parametrize(
    ("values", "split"),
    [
        ([100.0, 90.0, 80.0, -800.0], (-800.0, -800.0, 80.0, 100.0)),
        ([100.0, -700.0, 90.0, -800.0], (-800.0, -700.0, 90.0, 100.0)),
        ([100.0, 90.0, 50.0, 20.0], None),
        ([1.0, 1.0, 1.0], None),
        ([1.0, 2.0, float("nan")], None),
    ],
)
def test_an_axis_breaks_where_one_gap_takes_more_than_half_of_it(values: list[float], split: object) -> None:
    assert figures.axis_break([values]) == split


def test_an_axis_does_not_break_between_two_prices() -> None:
    assert figures.axis_break([[150.0, 148.0], [136.0, 134.0]]) is None
    assert figures.axis_break([[150.0, 148.0], [146.0, -134.0]]) == (-134.0, -134.0, 146.0, 150.0)


def test_what_was_judged_once_has_no_curve(grouped: Study, results: Results) -> None:
    assert figures.curves(grouped, results.curves, "frames") is not None
    ends = {name: points[-1:] for name, points in results.curves.items()}
    assert figures.curves(grouped, ends, "frames") is None


def test_the_numbers_of_a_figure_are_those_of_the_runs(grouped: Study, panel: Panel) -> None:
    figure = figures.against_cost(grouped, panel)
    world = "Z=5, c=0.22"
    runs = grouped.of(world, "a2c")
    rows = {row[1]: row for row in figure.table.rows if row[0] == 0.22}
    values = [run.figure("aihtr") for run in runs]
    assert rows["a2c"][2:] == [float(np.mean(values)), *rows["a2c"][3:5], 3]
    margin = 4.302652729911275 * np.std(values, ddof=1) / np.sqrt(3)  # Student's t with two degrees of freedom
    assert rows["a2c"][3:5] == pytest.approx([np.mean(values) - margin, np.mean(values) + margin])
    assert rows["Q_MDP"][2] == runs[0].figure("qmdp_aihtr")
    assert rows["printed bound"][2] == runs[0].figure("bound_paper")
    assert rows["optimum"][2] == grouped.lower(world)
    assert f"a2c: {figure.table.rows[0][2]:.1f}, {rows['a2c'][2]:.1f}" in figure.text
    assert "a2c n = 3" in figure.title


def test_regret_is_to_the_proved_bound(grouped: Study, panel: Panel) -> None:
    figure = figures.regret_against_cost(grouped, panel, None)
    rows = {(row[0], row[1]): row[2] for row in figure.table.rows}
    assert rows[0.16, "hindsight"] == float(np.mean(grouped.regrets("Z=5, c=0.16", "hindsight")))
    run = grouped.of("Z=5, c=0.16", "a2c")[0]
    expected = (run.figure("optimal_upper") - run.figure("qmdp_aihtr")) / run.figure("expected_length")
    assert rows[0.16, "Q_MDP"] == pytest.approx(expected)


def test_a_learning_curve_ends_where_the_runs_do(results: Results, grouped: Study) -> None:
    figure = figures.curves(grouped, results.curves, "frames")
    last = [row for row in figure.table.rows if row[0] == "a2c"][-1]
    regrets = [value for world in grouped.worlds for value in grouped.regrets(world, "a2c")]
    assert last[1] == pytest.approx(8000.0)
    assert last[2] == pytest.approx(float(np.mean(regrets)))
    assert last[5] == 6


def test_a_curve_is_a_staircase() -> None:
    curve = np.array([[10.0, 3.0], [20.0, 2.0], [40.0, 1.0]])
    assert [figures.value_at(curve, x) for x in (5, 10, 19, 20, 39, 40, 99)] == [3, 3, 3, 2, 2, 1, 1]


def test_profiles_count_runs(grouped: Study) -> None:
    figure = figures.profiles(grouped, None)
    row = next(row for row in figure.table.rows if row[0] == "a2c")
    regrets = [value for world in grouped.worlds for value in grouped.regrets(world, "a2c")]
    marks = (0.001, 0.005, 0.01, 0.02, 0.05, 0.1)
    assert row[1:] == [6, *(sum(value <= mark for value in regrets) / 6 for mark in marks)]


def test_a_map_draws_what_can_happen(results: Results) -> None:
    name = "hindsight-0.16-0"
    kept = next(policy for run, policy in results.policies.items() if run.startswith("hindsight-0.16"))
    motion = results.motions["a2c-0.16-0"]
    figure = maps.policy_map(name, "here", kept, motion, (3, 3))
    for located, n, on, possible, cells in figure.table.rows:
        assert on == kept.on(n).toarray()[located].sum() == len(str(cells).split())  # type: ignore[index]
        if n == 0:
            assert possible == (motion.kernel.toarray()[located] > 0).sum()  # type: ignore[call-overload]
    first = [row for row in figure.table.rows if row[1] == 0]
    assert len(first) == 9
    everything = Sensed(sparse.csr_array(np.ones(kept.sets.shape, dtype=bool)), kept.value)
    drawn = maps.policy_map(name, "here", everything, motion, (3, 3))
    assert drawn
    assert {row[1] for row in drawn.table.rows} == {0}  # no miss can happen, so there is no second set


def test_a_map_of_averaged_plans_fills_the_share_of_each_cell() -> None:
    """From cell 0 the target goes to 0 or 1; cell 1 is sensed on a quarter of the detections, cell 0 never."""
    shares = sparse.csr_array(np.array([[0.0, 0.25], [0.0, 1.0]]))
    kernel = sparse.csr_array(np.array([[0.5, 0.4], [0.0, 0.9]]))
    kept, motion = Sensed(shares, np.zeros(2)), MotionTable(kernel, np.zeros(2), np.zeros(2))
    figure = maps.policy_map("x", "here", kept, motion, (1, 2))
    assert [row[2:4] for row in figure.table.rows] == [[0.25, 2], [1.0, 1]]
    assert "At n = 0: 0.62 cells sensed, 0.88 possible ones left out on average." in figure.text
    assert "shares of the detections" in figure.text
    assert kept.averaged


def test_a_value_map_holds_every_cell(results: Results) -> None:
    name, kept = next(iter(results.policies.items()))
    motion = results.motions["a2c-0.16-0"]
    figure = maps.value_map(name, "here", kept, motion, (3, 3), maps.value_scales([(kept, motion)]))
    assert [row[3] for row in figure.table.rows] == kept.value.tolist()
    assert figure.table.rows[5][:3] == [5, 2, 3]
    assert [row[4] for row in figure.table.rows] == pytest.approx(motion.clocked - kept.value)
    assert [row[5] for row in figure.table.rows] == pytest.approx(motion.clocked - motion.qmdp)


def test_all_value_maps_of_a_page_have_the_same_scales() -> None:
    """One policy misses nothing, one 100 everywhere but in one cell, where it misses a million, which is clipped."""
    bound = np.full(100, 50.0)
    motion = MotionTable(sparse.csr_array((100, 100)), np.full(100, np.nan), bound)
    worse = bound - 100.0
    worse[7] = -1e6
    every = [Sensed(sparse.csr_array((200, 100), dtype=bool), value) for value in (bound, worse)]
    scales = maps.value_scales((each, motion) for each in every)
    assert scales == (maps.Scale("viridis", -50.0, 50.0), maps.Scale("magma_r", pytest.approx(1e-3), 100.0, log=True))
    drawn = [maps.value_map("x", "here", each, motion, (10, 10), scales).svg.decode() for each in every]
    one, other = (re.findall(r">(−?\d+|10[⁻⁰¹²³]+)</text>", each) for each in drawn)
    assert one == other and set(one) >= {"−40", "0", "40"} and sum("10" in each for each in one) >= 2
    assert maps.value_scales([(every[0], motion)])[1] == maps.Scale("magma_r", 1e-5, 1.0, log=True)  # nothing missing


def test_a_large_grid_is_drawn_as_means_over_tiles(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(maps, "MOST_MAP_CELLS", 20)
    monkeypatch.setattr(maps, "MOST_TILES", 3)
    # 5 rows of 7 cells, tiles of 3 x 3: two rows of three tiles, the last ones of 2 rows or 1 column.
    size, cells = (5, 7), 35
    value = np.arange(35.0)
    assert maps.binned(value, size).tolist() == pytest.approx(
        np.array([[8.0, 11.0, 13.0], [25.5, 28.5, 30.5]]), abs=1e-12
    )
    # Located in x, x % 4 sensors are on at once, and one after a miss.
    on = np.zeros((cells, 2, cells), dtype=bool)
    for x in range(cells):
        on[x, 0, : x % 4] = on[x, 1, 0] = True
    kept = Sensed(sparse.csr_array(on.reshape(2 * cells, cells)), value)
    motion = MotionTable(sparse.csr_array((cells, cells)), np.full(cells, np.nan), value + 0.5)
    sets = maps.policy_map("x", "here", kept, motion, size)
    number = maps.binned(np.arange(cells) % 4.0, size)
    assert [row[3] for row in sets.table.rows] == pytest.approx(number.ravel())
    assert [row[4] for row in sets.table.rows] == [1.0] * 6
    assert [row[:3] for row in sets.table.rows][4] == [24, 4, 4]
    assert "n = 0: mean 1.46" in sets.text and "tiles of 3 x 3 cells" in sets.text
    values = maps.value_map("x", "here", kept, motion, size, maps.value_scales([(kept, motion)]))
    # Q_MDP was not valued: two layers
    assert [len(row) for row in values.table.rows] == [5] * 6
    assert [row[4] for row in values.table.rows] == pytest.approx([0.5] * 6)


def test_the_same_figure_has_the_same_bytes_and_no_date(grouped: Study, panel: Panel) -> None:
    one, two = (figures.against_cost(grouped, panel) for _ in range(2))
    assert (one.svg, one.png) == (two.svg, two.png)
    assert b"date" not in one.svg.lower()
    assert one.png.startswith(b"\x89PNG")


def test_letters_that_the_font_lacks_stay_letters_without_a_warning() -> None:
    table = Table("f", "caption", [Column("x")], [[1]])
    drawn = draw_figure("title", "text", table, 1.0, lambda figure: figure.text(0.5, 0.5, "a\tb \u65e5"))
    assert "a\tb \u65e5" in drawn.svg.decode()


def test_in_the_page_a_figure_has_a_text_alternative_and_the_colours_of_the_page(grouped: Study, panel: Panel) -> None:
    figure = figures.regret_against_cost(grouped, panel, None)
    text = figure.html()
    assert 'role="img"' in text
    label = re.search(r'aria-labelledby="(\S+) (\S+)"', text)
    assert label
    assert f'<title id="{label[1]}">{figure.title}</title>' in text
    assert f'<desc id="{label[2]}">At c = 0.16, 0.22.' in text
    drawing = text[: text.index("<figcaption>")]
    assert not re.findall(r"#[0-9a-f]{6}", drawing), "a colour that does not change with the scheme"
    assert "<style" not in drawing
    assert "<image" not in drawing
    assert text.count("<table") == 1


def test_without_matplotlib_one_line_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert main(["report", f"sweep={tmp_path}", f"hydra.run.dir={tmp_path}/report"]) == 2
    assert re.search(r"needs matplotlib, which pip install .*\[report\]", capsys.readouterr().err)


def test_files_are_named_after_what_they_show() -> None:
    assert figures.slug("a2c, gamma=0.9-Z=5, c=0.16") == "a2c-gamma-0-9-z-5-c-0-16"
    assert "/" not in figures.slug("kernel=table, path=/a/b")


def test_a_long_title_becomes_a_name_that_a_file_can_have() -> None:
    one, other = (figures.slug("\U00020000" * 5_000 + end) for end in "ab")
    assert one != other and len(one.encode()) < 200
    assert figures.slug("a" * 5_000) == figures.slug("a" * 5_000) and len(figures.slug("a" * 5_000)) < 200


def test_a_map_of_a_rectangle_has_its_rows_and_columns(results: Results) -> None:
    name, kept = next(iter(results.policies.items()))
    motion = results.motions["a2c-0.16-0"]
    flat = maps.value_map(name, "here", kept, motion, (1, 9), maps.value_scales([(kept, motion)]))
    assert flat
    assert [row[1:3] for row in flat.table.rows] == [[1, column] for column in range(1, 10)]
    assert maps.policy_map(name, "here", kept, motion, (1, 9))
