"""The paper's sweep as it was run: what is kept of it, and that the report is made from that again."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from tests.helpers import later
from trackmdp.app.cli import main
from trackmdp.paper.calibration import chosen, load_openings
from trackmdp.paper.worlds import PRINTED_QMDP, pairs
from trackmdp.reports.grouping import Study, study
from trackmdp.reports.results import is_stored, load_results, save_results

KEPT = Path(__file__).parents[1] / "data/paper"

pytestmark = pytest.mark.skipif(not is_stored(KEPT), reason="the paper's sweep is not kept here")


@pytest.fixture(scope="module")
def grouped() -> Study:
    return study(load_results(KEPT).runs)


def test_it_is_small() -> None:
    assert sum(file.stat().st_size for file in KEPT.iterdir()) < 120_000


def test_every_pair_was_run_with_every_algorithm(grouped: Study) -> None:
    assert pairs(grouped).keys() == PRINTED_QMDP.keys()
    for world in pairs(grouped).values():
        for method, seeds in (
            ("hindsight", 5),
            ("a2c", 5),
            ("a2c_per_sensor", 5),
            ("ppo", 2),
            ("dqn", 1),
        ):
            assert sorted(run.seed for run in grouped.of(world, method)) == list(range(seeds)), (
                world,
                method,
            )


def test_its_kernels_are_those_of_the_rule(grouped: Study) -> None:
    known = load_openings(KEPT)
    assert known
    seeds = chosen(known.candidates)
    for (support_size, _), world in pairs(grouped).items():
        assert {run.settings["kernel.seed"] for run in grouped.of(world)} == {seeds[support_size]}


def test_the_default_comes_close_in_every_pair_and_a2c_is_above_qmdp(grouped: Study) -> None:
    for world in pairs(grouped).values():
        a2c = grouped.of(world, "a2c")
        simple = grouped.reference(world, "Q_MDP", "aihtr")
        assert min(run.figure("aihtr") for run in a2c) > simple, world
        assert max(grouped.values(world, "hindsight", "regret")) <= 0.01, world
        assert max(grouped.values(world, "a2c_per_sensor", "regret")) < 0.0025, world


@pytest.mark.parametrize(("words", "shown"), [([], False), *later([(["paper=true"], True)])])
def test_a_sweep_of_some_of_the_paper_s_worlds_is_not_taken_for_the_paper_s(
    tmp_path: Path, words: list[str], shown: bool
) -> None:
    results = load_results(KEPT)
    wanted = ("Z=5, c=0.16", "Z=3, c=0.16")
    grouped = study(results.runs)
    some = [run for world in grouped.worlds if world in wanted for run in grouped.of(world)]
    assert some
    part = tmp_path / "part"
    part.mkdir()
    save_results(replace(results, runs=some, maps=[]), part)
    shutil.copy(KEPT / "paper.json", part)  # known already, so that nothing is computed
    assert (
        main(["report", f"sweep={part}", f"hydra.run.dir={tmp_path / 'out'}", "quiet=true", *words])
        == 0
    )
    assert ("Table II" in (tmp_path / "out/report.html").read_text(encoding="utf-8")) is shown


@pytest.mark.slow
def test_the_report_is_made_again_from_what_is_kept(tmp_path: Path) -> None:
    for name in ("one", "two"):
        words = [
            f"sweep={KEPT}",
            f"hydra.run.dir={tmp_path / name}",
            "quiet=true",
            "threshold=0.02",
        ]
        assert main(["report", *words]) == 0
    pages = [(tmp_path / name / "report.html").read_bytes() for name in ("one", "two")]
    assert pages[0] == pages[1]
    for file in KEPT.iterdir():
        assert file.read_bytes() == (tmp_path / "one" / file.name).read_bytes(), file.name
