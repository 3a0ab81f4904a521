"""The page of a report: what it says, and what it does in a browser."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from tests.episodes.browser import CHROMIUM, Browser
from tests.reports.sweeps import write_run
from trackmdp.paper.calibration import Openings, candidates, checks, sensitivity
from trackmdp.paper.sections import accuracy_table, sections
from trackmdp.paper.worlds import pairs
from trackmdp.reports.gather import gather_runs
from trackmdp.reports.grouping import study
from trackmdp.reports.page import Report, build
from trackmdp.reports.results import Anomaly, Results
from trackmdp.reports.summaries import groups_table, methods_table
from trackmdp.training.folders import write_summary

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
                write_run(folder / f"{algo}-{z}-{cost}-{seed}", *words, cost=cost, seed=seed, wrong=wrong)
    found = gather_runs(folder)
    found.anomalies.append(Anomaly("</script><b>", "cut & gone"))  # type: ignore[attr-defined]
    return found


@pytest.fixture(scope="module")
def openings() -> Openings:
    every = [candidate for z in (3, 4, 5) for candidate in candidates(z, seeds=range(2))]
    return Openings(every, list(sensitivity(draws=[0])), checks(39, border="renormalize", t_max=1))


@pytest.fixture(scope="module")
def report(results: Results, openings: Openings) -> Report:
    return build(results, 0.02, sections(study(results.runs), openings))


def test_the_paper_s_worlds_are_found_by_z_and_price(results: Results) -> None:
    assert list(pairs(study(results.runs))) == list(PAIRS)


def test_a_price_for_each_cell_is_none_of_the_paper_s(results: Results) -> None:
    runs = [replace(run, settings={**run.settings, "cost.sensor": [0.22] * 100}) for run in results.runs]
    assert not pairs(study(runs))


def test_runs_are_counted_up_to_the_threshold_where_one_is_given(results: Results) -> None:
    grouped = study(results.runs)
    regrets = {m: [r for world in grouped.worlds for r in grouped.regrets(world, m)] for m in WRONG}
    threshold = sorted(regrets["hindsight"])[2]
    for table, expected in (
        (methods_table(grouped, threshold), {"a2c": 0, "hindsight": 3}),
        (groups_table(grouped, threshold), None),
    ):
        place = [column.label for column in table.columns].index(f"runs ≤ {threshold:g}")
        counted = [row[place] for row in table.rows]
        if expected:
            assert dict(zip(grouped.methods, counted, strict=True)) == expected
        assert sum(map(int, counted)) == 3  # type: ignore[arg-type]
    assert not [column for column in methods_table(grouped, None).columns if "≤" in column.label]


def test_a_budget_below_the_shipped_one_is_said(report: Report) -> None:
    assert "a2c: 4,000 of 4,096,000; hindsight: 4,000 of 300,000" in report.html()  # the stand-ins have 4,000 steps


def test_accuracies_stand_beside_the_printed_ones(results: Results) -> None:
    grouped = study(results.runs)
    rows = {tuple(row[:2]): row for row in accuracy_table(grouped, pairs(grouped)).rows}
    row = rows[5, 0.22]
    assert (row[2], row[4]) == (54.3, 90.21)
    runs = grouped.of("Z=5, c=0.22", "hindsight")
    assert row[3] == 100 * runs[0].figure("qmdp_accuracy")
    assert row[7] == pytest.approx(50 * sum(run.figure("accuracy") for run in runs))


@pytest.mark.slow
def test_the_same_results_give_the_same_page(results: Results, openings: Openings, report: Report) -> None:
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


def test_every_figure_has_a_text_alternative_its_numbers_and_its_n(report: Report) -> None:
    text = report.html()
    drawings = re.findall(r'<svg class="chart" role="img"[^>]*aria-labelledby="(\S+) (\S+)"', text)
    assert len(drawings) == len(report.figures) == text.count("<figure ")
    for label, description in drawings:
        for mark, name in ((label, "title"), (description, "desc")):
            found = re.search(rf'<{name} id="{re.escape(mark)}">(.+?)</{name}>', text)
            assert found, mark
    for figure in report.figures:
        assert re.search(r"\bn = \d", figure.title), figure.table.name
        assert figure.table.rows


def test_what_results_say_cannot_break_out_of_the_page(report: Report) -> None:
    text = report.html()
    assert text.count("</script>") == 1
    assert "&lt;/script&gt;&lt;b&gt;" in text
    assert "cut &amp; gone" in text


def test_the_printed_bound_is_shown_to_be_none(report: Report, results: Results) -> None:
    grouped = study(results.runs)
    table = next(table for table in report.tables if table.name == "bounds")
    for row, (_, world) in zip(table.rows, pairs(grouped).items(), strict=True):
        run = grouped.in_world(world)[0]
        assert row[-1] == ((grouped.lower(world) or 0.0) > run.figure("bound_paper"))
    assert "bound 41.93, a policy attains 42.56" in report.html()


def test_a_sweep_without_finished_runs_still_says_what_is_missing() -> None:
    page = build(Results([], anomalies=[Anomaly("a", "cut: it has no summary.json")])).html()
    assert "cut: it has no summary.json" in page


def test_runs_on_recorded_tracks_have_neither_bound_nor_regret(tmp_path: Path) -> None:
    for cost in (0.16, 0.22):
        place = tmp_path / str(cost)
        write_run(place, "grid.size=3", cost=cost)
        summary = json.loads((place / "summary.json").read_text())
        summary |= {"qmdp": None, "bounds": dict.fromkeys(("paper", "valid", "clocked")), "optimal": None}
        config = (place / "config.yaml").read_text()
        (place / "config.yaml").write_text(config.replace("name: random_support", "name: tracks"))
        write_summary(place, {key: value for key, value in summary.items() if key != "sha256"})
    found = gather_runs(tmp_path)
    assert not found.anomalies
    assert not found.motions
    made = build(found)
    assert [figure.table.name for figure in made.figures] == ["aihtr-tracks-z-5"]
    table = next(table for table in made.tables if table.name == "methods")
    assert "nan" not in table.html()


@pytest.fixture
def browser(tmp_path: Path) -> Iterator[Browser]:
    with Browser(tmp_path / "profile") as opened:
        yield opened


ROWS = "[...document.querySelectorAll('#outcome table')[0].tBodies[0].rows].map((row) => row.cells[0].textContent)"
HEADS = "document.querySelectorAll('#outcome table')[0].tHead.rows[0].cells"


@pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed")
def test_the_page_in_a_browser(report: Report, browser: Browser, tmp_path: Path) -> None:
    file = tmp_path / "report.html"
    file.write_text(report.html(), encoding="utf-8")
    for width, scheme, colour in ((390, "dark", "rgb(22, 24, 27)"), (1280, "light", "rgb(255, 255, 255)")):
        browser.view(width, 844, scheme)
        browser.open(file)
        assert browser.ask("document.documentElement.scrollWidth") <= width
        assert browser.ask("getComputedStyle(document.body).backgroundColor") == colour
        assert browser.ask("document.querySelectorAll('svg.chart').length") == len(report.figures)
        narrow = "[...document.querySelectorAll('svg.chart')].every((svg) => svg.getBoundingClientRect().width > 250)"
        assert browser.ask(narrow)
        assert browser.smallest_letters() >= 11
    assert browser.ask(ROWS) == ["a2c", "hindsight"]
    browser.ask(f"{HEADS}[3].querySelector('button').focus()")
    browser.press(" ")
    assert browser.ask(f"{HEADS}[3].getAttribute('aria-sort')") == "ascending"
    assert browser.ask(ROWS) == ["hindsight", "a2c"]  # by regret, smallest first
    browser.press(" ")
    assert browser.ask(f"{HEADS}[3].getAttribute('aria-sort')") == "descending"
    assert browser.ask(ROWS) == ["a2c", "hindsight"]
    browser.ask(f"{HEADS}[0].querySelector('button').focus()")
    browser.press(" ")
    assert browser.ask(f"{HEADS}[3].hasAttribute('aria-sort')") is False
    assert browser.ask(f"{HEADS}[0].getAttribute('aria-sort')") == "ascending"
    assert browser.problems == []
