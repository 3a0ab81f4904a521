"""Figures: their numbers, their limits and looks, and the same bytes each time."""

from __future__ import annotations

import re
import sys
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pytest
from matplotlib.figure import Figure as Canvas

from tests.reports.sweeps import write_sweep
from tests.reports.test_grouping import run
from trackmdp.app.cli import main
from trackmdp.reports import figures
from trackmdp.reports.figures import Line, Panel
from trackmdp.reports.gather import gather_runs
from trackmdp.reports.grouping import Study, study
from trackmdp.reports.results import Results
from trackmdp.reports.style import LOOKS, PALETTE, REFERENCES, Figure, draw_figure, legend, looks_of
from trackmdp.reports.tables import Column, Table
from trackmdp.reports.tradeoffs import swept_figure
from trackmdp.statistics import MeanInterval

EMPTY = Table("f", "caption", [Column("x")], [[1]])


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


def drawn(grouped: Study, panel: Panel, key: str) -> Figure:
    figure = figures.against_price(grouped, panel, key, threshold=0.02)
    assert figure
    return figure


def test_worlds_that_differ_in_price_make_a_panel(panel: Panel) -> None:
    title, worlds = panel
    assert (title, [*worlds.items()]) == ("Z=5", [(0.16, "Z=5, c=0.16"), (0.22, "Z=5, c=0.22")])


def test_the_numbers_of_a_figure_are_those_of_the_runs(grouped: Study, panel: Panel) -> None:
    figure = drawn(grouped, panel, "aihtr")
    world = "Z=5, c=0.22"
    runs = grouped.of(world, "a2c")
    rows = {row[0]: row for row in figure.table.rows if row[1] == 0.22}
    values = [run.figure("aihtr") for run in runs]
    # Student's t with two degrees of freedom
    margin = 4.302652729911275 * np.std(values, ddof=1) / np.sqrt(3)
    mean = float(np.mean(values))
    assert rows["a2c"][2:] == pytest.approx([mean, mean - margin, mean + margin, 3])
    assert rows["Q_MDP"][2:] == [runs[0].references["Q_MDP"]["aihtr"], None, None, None]
    assert rows["printed bound"][2] == runs[0].references["printed bound"]["aihtr"]
    assert rows["all on"][2] == runs[0].references["all on"]["aihtr"]
    assert "n = 3 seeds" in figure.table.caption


def test_learned_policies_lie_over_the_frontier_of_the_solved_ones() -> None:
    """At prices 1 to 4: the second lies below the line from the first to the third, the fourth gains nothing."""
    solved = [(1.0, 4.0, 0.9), (2.0, 3.0, 0.7), (3.0, 1.0, 0.5), (4.0, 5.0, 0.8)]
    runs = []
    for price, sensors, accuracy in solved:
        best = {"best known": {"aihtr": 1.0, "sensors_per_step": sensors, "accuracy": accuracy}}
        for seed in range(2):
            options = {"cost.sensor": price, "seed": seed}
            figures_of_run = {
                "aihtr": 0.5,
                "expected_length": 2.0,
                "sensors_per_step": sensors + 0.5 * seed,
                "accuracy": accuracy - 0.1 * seed,
            }
            made = run(f"{price}-{seed}", "algo=a2c", options=options, **figures_of_run)
            runs.append(replace(made, references=best))
    options = {"cost.sensor": 1.0, "kernel.support_size": 9}
    found = study([*runs, run("elsewhere", "algo=ppo", options=options)])
    (priced,) = figures.panels(found)
    figure = swept_figure(found, priced)
    assert figure and b">a2c<" in figure.svg and b">ppo<" not in figure.svg  # of another world
    rows = {(row[0], row[1]): row[2:] for row in figure.table.rows}
    line = {price: rows["best known", price][2] for price, *_ in solved}
    assert line == {1.0: True, 2.0: False, 3.0: True, 4.0: False}
    for price, sensors, accuracy in solved:
        assert rows["best known", price][:2] == [sensors, accuracy]
        assert rows["a2c", price][:2] == pytest.approx([sensors + 0.25, accuracy - 0.05])
    assert "line: " in figure.table.caption
    unsolved = study([replace(each, references={}) for each in runs])  # as on recordings
    alone = swept_figure(unsolved, priced)
    assert alone
    assert "line: " not in alone.table.caption
    assert alone.table.caption.endswith("; n = 2 seeds")
    once = study([each for each in runs if each.seed == 0])
    for figure in (swept_figure(once, priced), figures.against_price(once, priced, "aihtr", None)):
        assert figure and figure.table.caption.endswith("; n = 1 seed")


def test_exact_lines_stand_at_the_true_price_and_learned_ones_beside_it(
    grouped: Study, panel: Panel, monkeypatch: pytest.MonkeyPatch
) -> None:
    found: list[Any] = []
    monkeypatch.setattr(figures, "legend", lambda figure, axes: found.append(axes))
    drawn(grouped, panel, "aihtr")
    lines = {line.get_label().lstrip("_"): line.get_xdata()[0] for line in found[0].lines}
    learned = np.array([lines.pop(method) for method in grouped.methods])
    assert set(lines.values()) == {0.16}
    assert learned.mean() == pytest.approx(0.16)
    assert 0 < np.ptp(learned) <= 0.03 * 0.06


def test_the_legend_names_the_lines_in_sight(grouped: Study, panel: Panel) -> None:
    """All sensors on earns thousands less, and switches on nine; its regret is in sight."""
    for key in ("aihtr", "sensors_per_step"):
        assert ">all on<" not in drawn(grouped, panel, key).svg.decode()
    assert ">all on<" in drawn(grouped, panel, "regret").svg.decode()


@pytest.mark.parametrize("key", ["accuracy", "sensors_per_step"])
def test_accuracy_and_sensors_stand_beside_the_regret(
    key: str, grouped: Study, panel: Panel
) -> None:
    rows = {(row[0], row[1]): row[2] for row in drawn(grouped, panel, key).table.rows}
    values = [run.figure(key) for run in grouped.of("Z=5, c=0.16", "hindsight")]
    assert rows["hindsight", 0.16] == pytest.approx(float(np.mean(values)))
    assert ("Q_MDP", 0.16) in rows


def test_regret_is_to_the_proved_bound(grouped: Study, panel: Panel) -> None:
    rows = {(row[0], row[1]): row[2] for row in drawn(grouped, panel, "regret").table.rows}
    world = "Z=5, c=0.16"
    assert rows["hindsight", 0.16] == np.mean(grouped.values(world, "hindsight", "regret"))
    run = grouped.of(world, "a2c")[0]
    missing = run.figure("optimal_upper") - (run.references["Q_MDP"]["aihtr"] or 0.0)
    assert rows["Q_MDP", 0.16] == pytest.approx(missing / run.figure("expected_length"))
    assert not any("bound" in name for name, _ in rows)


def exact(name: str, *values: float) -> Line:
    row = [MeanInterval(value, None, None, 0) for value in values]
    return Line(name, REFERENCES.get(name, LOOKS[0]), list(range(len(values))), row)


def test_an_axis_shows_the_best_policies_and_not_those_far_below() -> None:
    best = exact("best known", 100.0, 90.0)
    low, high = figures._limits([exact("a", 99.0, 85.0), exact("b", -400.0, -500.0)], [best])
    assert 55 < low < 65 and 100 < high < 110  # three ranges of 10 below 90
    low, high = figures._limits([exact("a", 99.0, 85.0), exact("b", 80.0, float("nan"))], [best])
    assert 75 < low < 80
    assert figures._limits([exact("a", 1.0, 1.0)], []) == pytest.approx((0.9, 1.1))


def test_a_learning_curve_ends_where_the_runs_do(grouped: Study) -> None:
    figure = figures.learning(grouped, "frames")
    assert figure
    rows = [row for row in figure.table.rows if row[0] == "a2c"]
    assert rows[0][1] == pytest.approx(200.0)
    regrets = grouped.regrets("a2c")
    lines = figures._curves(grouped, "a2c", 0)
    last = figures._mean_curve("a2c", LOOKS[0], lines)
    assert last.x[-1] == pytest.approx(8000.0)
    assert last.row[-1].mean == pytest.approx(np.mean([np.mean(each) for each in regrets]))
    assert last.row[-1].n == 6


def test_a_method_that_learns_at_the_end_has_a_sentence_and_no_curve(results: Results) -> None:
    flat = [(100.0, 1.0, -50.0), (200.0, 2.0, -49.0), (300.0, 3.0, -49.5)]
    runs = [
        replace(run, curve=[*flat, (400.0, 4.0, run.figure("aihtr"))])
        if run.algo == "hindsight"
        else run
        for run in results.runs
    ]
    grouped = study(runs)
    assert figures.late_learners(grouped) == {"hindsight": 4000.0}
    figure = figures.learning(grouped, "seconds")
    assert figure and {row[0] for row in figure.table.rows} == {"a2c"}
    once = study([replace(run, curve=run.curve[-1:]) for run in runs])
    assert figures.late_learners(once).keys() == {"a2c", "hindsight"}
    assert figures.learning(once, "frames") is None


def test_a_curve_is_a_staircase() -> None:
    curve = np.array([[10.0, 3.0], [20.0, 2.0], [40.0, 1.0]])
    grid = np.array([5.0, 10.0, 19.0, 20.0, 39.0, 40.0, 99.0])
    assert figures.values_at(curve, grid).tolist() == [3, 3, 3, 2, 2, 1, 1]


def test_profiles_count_runs(grouped: Study) -> None:
    figure = figures.profiles(grouped, None)
    assert figure
    regrets = [value for each in grouped.regrets("a2c") for value in each]
    rows = [row for row in figure.table.rows if row[0] == "a2c"]
    assert len(rows) == 5
    for _, level, part, *_, n in rows:
        assert part == sum(value <= level for value in regrets) / 6  # type: ignore[operator]
        assert n == 6


def test_the_same_figure_has_the_same_bytes_and_no_date(grouped: Study, panel: Panel) -> None:
    one, two = (drawn(grouped, panel, "aihtr") for _ in range(2))
    assert (one.svg, one.png) == (two.svg, two.png)
    assert b"date" not in one.svg.lower()
    assert one.png.startswith(b"\x89PNG")


@pytest.mark.parametrize("own", [{"text.usetex": True}, {"axes.grid": True, "savefig.dpi": 9}])
def test_a_figure_is_drawn_without_the_settings_of_the_user(own: dict[str, Any]) -> None:
    """A `matplotlibrc` is also read from the current folder, and may have LaTeX run on the labels."""

    def drawn() -> Figure:
        return draw_figure(EMPTY, 1.0, lambda figure: figure.add_subplot().set_xlabel("a label"))

    plain = drawn()
    with matplotlib.rc_context(own):
        changed = drawn()
    assert (changed.svg, changed.png) == (plain.svg, plain.png)


def test_letters_that_the_font_lacks_stay_letters_without_a_warning() -> None:
    made = draw_figure(EMPTY, 1.0, lambda figure: figure.text(0.5, 0.5, "a\tb \u65e5"))
    assert "a\tb \u65e5" in made.svg.decode()


def test_in_the_page_a_figure_has_a_name_its_numbers_and_the_colours_of_the_page(
    grouped: Study, panel: Panel
) -> None:
    figure = drawn(grouped, panel, "regret")
    text = figure.html()
    assert re.search(
        rf'role="img" viewBox="[^"]+"[^>]* aria-label="{re.escape(figure.table.caption)}"', text
    )
    drawing = text[: text.index("<figcaption>")]
    assert not re.findall(r"#[0-9a-f]{6}", drawing), "a colour that does not change with the scheme"
    assert "<style" not in drawing
    assert "<image" not in drawing
    assert text.count("<table") == 1


def test_every_colour_of_the_files_is_one_of_the_page() -> None:
    looks = [*LOOKS, *REFERENCES.values()]
    assert {look.color for look in looks} <= PALETTE.keys()
    page = files("trackmdp.reports").joinpath("report.html").read_text(encoding="utf-8")
    for name in PALETTE.values():
        assert len(re.findall(rf"--{name}: #", page)) == 2, (
            f"{name}: in the light and the dark scheme"
        )


@pytest.mark.parametrize("count", [3, 8, 20])
def test_every_method_has_a_colour_and_a_mark_of_its_own(count: int) -> None:
    looks = looks_of([f"method {number}" for number in range(count)])
    assert len({(look.color, look.linestyle) for look in looks.values()}) == min(count, 16)
    first = [*looks.values()][:8]
    assert len({look.color for look in first}) == len({look.marker for look in first}) == len(first)


@pytest.mark.parametrize("letters", [3, 15, 30, 120])
def test_a_legend_lies_below_the_axes_and_within_the_figure(letters: int) -> None:
    def paint(figure: Canvas) -> None:
        axes = figure.subplots()
        for name in "abcd":
            axes.plot([0, 1], [0, 1], label=" ".join(name * 5 for _ in range(letters // 5 + 1)))
        legend(figure, axes)
        figure.draw_without_rendering()
        box = figure.legends[0].get_window_extent()
        assert box.y1 <= axes.get_window_extent().y0
        assert box.x0 >= 0 and box.x1 <= figure.bbox.x1

    draw_figure(EMPTY, 3.3, paint)


def test_without_matplotlib_one_line_names_the_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert main(["report", f"sweep={tmp_path}", f"hydra.run.dir={tmp_path}/report"]) == 2
    assert re.search(r"needs matplotlib, which pip install .*\[report\]", capsys.readouterr().err)


def test_a_misspelt_backend_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delitem(sys.modules, "matplotlib")
    monkeypatch.setenv("MPLBACKEND", "ag")
    sweep = write_sweep(tmp_path)
    assert main(["report", f"sweep={sweep}", f"hydra.run.dir={tmp_path}/report"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("trackmdp report: MPLBACKEND: Key backend: 'ag' is not a valid value")


def test_files_are_named_after_their_titles() -> None:
    assert figures.slug("a2c, gamma=0.9, Z=5, c=0.16") == "a2c-gamma-0-9-z-5-c-0-16"
    assert "/" not in figures.slug("kernel=table, path=/a/b")
    alike = ("path=A.npy", "path=a.npy", "path=a/npy", "origin=-1x2", "origin=1x2")
    assert len({figures.slug(f"table, {each}") for each in alike}) == len(alike)
    one, other = (figures.slug("\U00020000" * 5_000 + end) for end in "ab")
    assert one != other and len(one.encode()) < 200


def test_a_path_that_reads_like_a_price_is_a_panel_of_its_own() -> None:
    paths = [{"kernel.name": "table", "kernel.path": f"a, c={n}.npy"} for n in (2, 3)]
    runs = [
        run(f"{path}{c}", options=path | {"cost.sensor": c}) for path in paths for c in (0.1, 0.2)
    ]
    found = study(runs)
    assert [[*worlds] for _, worlds in figures.panels(found)] == [[0.1, 0.2], [0.1, 0.2]]
    drawn = [world for _, worlds in figures.panels(found) for world in worlds.values()]
    assert sorted(drawn) == sorted(found.worlds)
