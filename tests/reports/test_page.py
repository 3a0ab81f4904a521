"""The page of a report: what it says, and what it does in a browser."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.episodes.browser import CHROMIUM, Browser
from tests.reports.sweeps import plan, write_run
from tests.tracks import by_hand, recorded
from trackmdp.config.compose import compose
from trackmdp.paper.calibration import Openings, load_openings
from trackmdp.paper.sections import accuracy_table, sections
from trackmdp.paper.worlds import pairs
from trackmdp.reports.gather import gather_runs
from trackmdp.reports.grouping import study
from trackmdp.reports.page import Report, build
from trackmdp.reports.results import Anomaly, Results
from trackmdp.reports.summaries import groups_table, outcome_table
from trackmdp.training.folders import write_summary
from trackmdp.world.problem_file import problem_bytes

PAIRS = ((3, 0.22), (5, 0.16), (5, 0.22))
WRONG = {"a2c": 40, "hindsight": 1}


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Results:
    """Some of the paper's worlds; A2C is far off, the default is not."""
    folder = tmp_path_factory.mktemp("paper")
    for z, cost in PAIRS:
        for algo, wrong in WRONG.items():
            for seed in range(2):
                words = (f"kernel.support_size={z}", f"algo={algo}")
                write_run(
                    folder / f"{algo}-{z}-{cost}-{seed}", *words, cost=cost, seed=seed, wrong=wrong
                )
    found = gather_runs(folder)
    found.anomalies.append(Anomaly("</script><b>", "cut & gone"))  # type: ignore[attr-defined]
    return replace(found, maps=found.maps[:2])


@pytest.fixture(scope="module")
def openings() -> Openings:
    kept = load_openings(Path(__file__).parents[1] / "data/paper")
    assert kept
    return kept


@pytest.fixture(scope="module")
def report(results: Results, openings: Openings) -> Report:
    return build(results, 0.02, sections(study(results.runs), openings))


def test_the_paper_s_worlds_are_found_by_z_and_price(results: Results) -> None:
    assert list(pairs(study(results.runs))) == list(PAIRS)


@pytest.mark.parametrize(
    "other",
    [
        {"cost.sensor": [0.22] * 100},  # a price for each cell
        {"sensor.name": "miss", "sensor.p_d": 0.5},
        {"cost.budget": 2},
        {"cost.mean_budget": 2.0},
        {"targets.count": 2},
    ],
)
def test_worlds_with_what_the_paper_does_not_have_are_none_of_its(
    results: Results, other: dict[str, Any]
) -> None:
    runs = [replace(run, settings={**run.settings, **other}) for run in results.runs]
    assert not pairs(study(runs))


def test_runs_are_counted_up_to_the_threshold_where_one_is_given(results: Results) -> None:
    grouped = study(results.runs)
    regrets = {m: [r for group in grouped.regrets(m) for r in group] for m in WRONG}
    threshold = sorted(regrets["hindsight"])[2]
    for table, expected in (
        (outcome_table(grouped, threshold), {"a2c": 0, "hindsight": 3}),
        (groups_table(grouped, threshold), None),
    ):
        place = [column.label for column in table.columns].index(f"runs ≤ {threshold:g}")
        counted = [row[place] for row in table.rows if row[place] is not None]
        if expected:
            assert dict(zip(grouped.methods, counted, strict=True)) == expected
        assert sum(map(int, counted)) == 3  # type: ignore[arg-type]
    assert not [column for column in outcome_table(grouped, None).columns if "≤" in column.label]


def test_a_budget_below_the_default_is_named(report: Report) -> None:
    """The stand-ins have 4,000 steps."""
    defaults = {algo: compose("train", {"algo": algo}).algo.total_frames for algo in WRONG}
    named = "; ".join(f"{algo}: 4,000 of {full:,}" for algo, full in defaults.items())
    assert named in report.html()


def test_accuracies_stand_beside_the_printed_ones(results: Results) -> None:
    grouped = study(results.runs)
    rows = {tuple(row[:2]): row for row in accuracy_table(grouped, pairs(grouped)).rows}
    row = rows[5, 0.22]
    assert (row[2], row[4]) == (54.3, 90.21)
    runs = grouped.of("Z=5, c=0.22", "hindsight")
    assert row[3] == 100 * (runs[0].references["Q_MDP"]["accuracy"] or 0.0)
    assert row[7] == pytest.approx(50 * sum(run.figure("accuracy") for run in runs))


@pytest.mark.long
def test_the_same_results_give_the_same_page(
    results: Results, openings: Openings, report: Report
) -> None:
    again = build(results, 0.02, sections(study(results.runs), openings))
    assert again.html() == report.html()
    assert [figure.png for figure in again.figures] == [figure.png for figure in report.figures]


def test_the_page_is_one_file_that_asks_for_nothing(report: Report) -> None:
    text = report.html()
    assert not re.findall(r'(?:src=|href="[^#])|url\((?!#)|@import|fetch\(', text)
    assert "default-src 'none'" in text
    anchors = re.findall(r'<li><a href="#([\w-]+)">', text)
    assert anchors == [section.anchor for section in report.sections]
    ids = re.findall(r'\bid="([^"]+)"', text)
    assert len(ids) == len(set(ids))


def test_every_figure_has_a_name_its_numbers_and_its_n(report: Report) -> None:
    text = report.html()
    names = re.findall(r'<svg class="chart" role="img"[^>]* aria-label="([^"]+)"', text)
    assert len(names) == len(report.figures) == text.count("<figure ")
    for figure in report.figures:
        assert re.search(r"\bn = \d", figure.table.caption), figure.table.name
        assert figure.table.rows


def test_no_two_columns_of_a_table_have_one_heading_and_prices_have_all_digits(
    report: Report,
) -> None:
    for table in (*report.tables, *(figure.table for figure in report.figures)):
        heads = [column.heading for column in table.columns]
        assert len({*heads}) == len(heads), table.name
        prices = [column for column in table.columns if column.label.startswith("c, price")]
        assert all(column.text(0.125) == "0.125" for column in prices)


def test_the_words_of_the_page_are_explained_on_it(report: Report) -> None:
    words = re.search(r'<section id="words">.*?</section>', report.html(), re.DOTALL)
    assert words
    for word in ("AIHTR", "accuracy", "regret per step", "Q_MDP", "all on", "optimum", "T_max"):
        assert re.search(rf"<dt>[^<]*{word}", words[0]), word
    for bound in ("clocked", "valid", "printed"):
        assert f"{bound} bound" in words[0]


def test_texts_of_results_cannot_break_out_of_the_page(report: Report) -> None:
    text = report.html()
    assert text.count("</script>") == 1
    assert "&lt;/script&gt;&lt;b&gt;" in text
    assert "cut &amp; gone" in text


def test_the_printed_bound_is_shown_to_be_none(report: Report, results: Results) -> None:
    grouped = study(results.runs)
    table = next(table for table in report.tables if table.name == "bounds")
    for row, (_, world) in zip(table.rows, pairs(grouped).items(), strict=True):
        run = grouped.of(world)[0]
        printed = run.references["printed bound"]["aihtr"]
        assert printed is not None and row[-1] == (grouped.best(world) > printed)
    assert "bound 41.93, a policy attains 42.56" in report.html()


def test_a_sweep_without_finished_runs_still_says_what_is_missing() -> None:
    page = build(Results([], anomalies=[Anomaly("a", "cut: it has no summary.json")])).html()
    assert "cut: it has no summary.json" in page


def test_one_run_is_not_several(results: Results) -> None:
    alone = Results(results.runs[:1], manifest={"versions": [{"runs": 1, "numpy": "2.0"}]})
    page = build(alone).html()
    assert "1 run, 0.0 minutes" in page and "Versions, 1 run<" in page


def test_runs_on_recordings_have_no_regret_and_held_out_figures_under_their_name(
    tmp_path: Path,
) -> None:
    for cost in (0.16, 0.22):
        place = tmp_path / str(cost)
        write_run(place, "grid.size=3", cost=cost)
        summary = json.loads((place / "summary.json").read_text())
        parts = ("aihtr", "accuracy", "sensors_per_step")
        summary |= {
            "validation": summary["policy"] | {"aihtr": 7.0},
            "qmdp": None,
            "bounds": dict.fromkeys(("paper", "valid", "clocked")),
            "references": {},
            "optimal": None,
            "held_out": {"figures": {"no sensors": {key: {"mean": -3.0} for key in parts}}},
        }
        (place / "problem.npz").write_bytes(problem_bytes(recorded(by_hand([0, 1, 2]))))
        plain = {key: value for key, value in summary.items() if key not in ("sha256", "files")}
        write_summary(place, plain)
    found = gather_runs(tmp_path)
    assert not found.anomalies
    assert not found.maps
    made = build(found)
    drawn = [figure.table.name for figure in made.figures]
    assert drawn == ["aihtr-z-5", "accuracy-z-5", "sensors-per-step-z-5", "frontier-z-5"]
    assert "out of sight" in made.html()
    assert "grey line" not in made.html()  # no best policy is known, and none is drawn
    solved = [replace(run, references={"best known": {"aihtr": 8.0}}) for run in found.runs]
    assert "grey line" in build(replace(found, runs=solved)).html()
    table = next(table for table in made.tables if table.name == "outcome")
    heads = [column.label for column in table.columns]
    learned, reference = table.rows
    assert learned[heads.index("AIHTR")] == 7.0
    assert (reference[0], reference[heads.index("held-out AIHTR")]) == ("no sensors", -3.0)
    assert "nan" not in table.html()


@pytest.fixture
def browser(tmp_path: Path) -> Iterator[Browser]:
    with Browser(tmp_path / "profile") as opened:
        yield opened


def place(label: str) -> str:
    """The heading of a column of the first table."""
    return f"[...{HEADS}].findIndex((head) => head.textContent.startsWith('{label}'))"


ROWS = "[...document.querySelectorAll('#outcome table')[0].tBodies[0].rows].map((row) => row.cells[0].textContent)"
HEADS = "document.querySelectorAll('#outcome table')[0].tHead.rows[0].cells"


@pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed")
def test_the_page_in_a_browser(report: Report, browser: Browser, tmp_path: Path) -> None:
    file = tmp_path / "report.html"
    file.write_text(report.html(), encoding="utf-8")
    for width, scheme, colour in (
        (390, "dark", "rgb(22, 24, 27)"),
        (1280, "light", "rgb(255, 255, 255)"),
    ):
        browser.view(width, 844, scheme)
        browser.open(file)
        assert browser.ask("document.documentElement.scrollWidth") <= width
        assert browser.ask("getComputedStyle(document.body).backgroundColor") == colour
        assert browser.ask("document.querySelectorAll('svg.chart').length") == len(report.figures)
        narrow = "[...document.querySelectorAll('svg.chart')].every((svg) => svg.getBoundingClientRect().width > 250)"
        assert browser.ask(narrow)
        assert browser.smallest_letters() >= 11
        assert browser.touching_letters() == []
    assert browser.ask(ROWS)[:2] == ["a2c", "hindsight"]
    regret = browser.ask(place("regret"))
    browser.ask(f"{HEADS}[{regret}].querySelector('button').focus()")
    browser.press(" ")
    assert browser.ask(f"{HEADS}[{regret}].getAttribute('aria-sort')") == "ascending"
    ascending = browser.ask(ROWS)
    assert (ascending[0], ascending[-1]) == ("hindsight", "all on")
    browser.press(" ")
    assert browser.ask(f"{HEADS}[{regret}].getAttribute('aria-sort')") == "descending"
    assert browser.ask(ROWS) == ascending[::-1]
    browser.ask(f"{HEADS}[0].querySelector('button').focus()")
    browser.press(" ")
    assert browser.ask(f"{HEADS}[{regret}].hasAttribute('aria-sort')") is False
    assert browser.ask(f"{HEADS}[0].getAttribute('aria-sort')") == "ascending"
    assert browser.problems == []


def test_without_a_solver_a_bound_counts_as_attained_only_where_a_learned_policy_attains_it(
    results: Results, openings: Openings
) -> None:
    unsolved = {"optimal_lower": None, "optimal_upper": None}
    runs = [replace(run, figures={**run.figures, **unsolved}) for run in results.runs]
    text = sections(study(runs), openings)[-1].html()
    assert (
        "is attained by a policy in 0 of 3 pairs, by none that is known in Z = 3, c = 0.22" in text
    )
    best = study(runs).best(study(runs).worlds[0])
    assert f'data-v="{best!r}"' in text


def test_runs_of_an_earlier_line_count_as_planned_but_copies_do_not(tmp_path: Path) -> None:
    for seed in range(2):
        write_run(tmp_path / str(seed), "grid.size=3", seed=seed)
    shutil.copytree(tmp_path / "0", tmp_path / "z")
    plan(tmp_path, "0", "ppo")  # the second line, in the folder of the first
    page = build(replace(gather_runs(tmp_path), maps=[])).html()
    assert "2 of 3 planned runs" in page
    assert "<dt>Last command</dt>" in page
    plan(tmp_path, "0", "1")
    page = build(replace(gather_runs(tmp_path), maps=[])).html()
    assert "2 of 2 planned runs" in page
    assert "<dt>Command</dt>" in page
