"""Reports of runs with several targets: figures of all targets together, beside their bracket."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import trackmdp as tm
from tests.tracks import by_hand, recorded
from trackmdp.reports.gather import gather_runs
from trackmdp.reports.grouping import study
from trackmdp.reports.page import Report, build
from trackmdp.reports.results import load_results, save_results
from trackmdp.world.group import Group

FEW: dict[str, Any] = {"total_frames": 512, "frames_per_batch": 256, "envs": 32}


@pytest.fixture(scope="module")
def sweep(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One learner that merges, one that learns of both targets, and the first with a single target."""
    folder = tmp_path_factory.mktemp("several")
    pair = tm.make_world("random_walk", size=3, exit_probability=0.2, targets=2)
    tm.train(pair, "model_based", folder=folder / "merged", **FEW)
    tm.train(
        pair, "model_based", seed=1, folder=folder / "brief", **FEW, **{"optimal.enabled": False}
    )
    joint: dict[str, Any] = FEW | {"hidden": 8, "evaluation.width": 0.2}
    tm.train(pair, "a2c", folder=folder / "joint", **joint)
    tm.train(pair.kinds[0], "model_based", folder=folder / "single", **FEW)
    return folder


def rows(found: Report, name: str) -> dict[str, dict[str, Any]]:
    (table,) = (each for each in found.tables if each.name == name)
    heads = [column.heading for column in table.columns]
    return {str(row[-1]): dict(zip(heads, row, strict=True)) for row in table.rows}


def test_a_row_has_the_figures_of_all_targets_beside_their_bracket(
    sweep: Path, tmp_path: Path
) -> None:
    save_results(gather_runs(sweep), tmp_path)
    found = rows(build(load_results(tmp_path)), "runs")
    for name in ("merged", "joint"):
        summary, row = tm.load_run(sweep / name).summary, found[name]
        several = summary["several"]
        assert "K=2" in row["world"]
        assert row["AIHTR"] == several["figures"]["aihtr"]["mean"]
        assert row["sensors per step"] == several["figures"]["sensors_per_step"]["mean"]
        assert row["accuracy (%)"] == 100 * several["figures"]["accuracy"]["mean"]
        merged = several["merged_optimum"]["aihtr"]["mean"]
        assert row["best AIHTR known"] == max(merged, several["lower"] or merged)
        assert row["upper bound"] == several["upper"] > row["best AIHTR known"]
        missing = several["upper"] - row["AIHTR"]
        assert row["regret per step"] == pytest.approx(missing / several["expected_length"])
    alone = found["single"]
    assert "K=1" in alone["world"]
    assert alone["upper bound"] is None
    assert found["merged"]["AIHTR"] > alone["AIHTR"]


def test_single_targets_are_no_reference_and_give_no_curve(sweep: Path) -> None:
    found = gather_runs(sweep)
    assert not found.anomalies
    runs = {run.name: run for run in found.runs}
    for name in ("merged", "joint"):
        assert set(runs[name].references) == {"best known", "separate trackers", "clocked bound"}
    assert set(runs["brief"].references) == {"clocked bound"}  # it was not solved for
    assert "Q_MDP" in runs["single"].references
    assert not runs["merged"].curve
    assert runs["joint"].curve and runs["single"].curve
    # A map shows the sets of one target's cell.
    assert {each.world for each in found.maps} == {
        world for world in study(found.runs).worlds if "K=1" in world
    }


def test_on_recorded_tracks_figures_are_of_all_targets_and_have_no_bound(tmp_path: Path) -> None:
    tracks = by_hand(*(np.random.default_rng(k).integers(9, size=6).tolist() for k in range(12)))
    targets = Group.of_tracks(recorded(tracks), 2)
    run = tm.train(targets, "model_based", folder=tmp_path / "a", **FEW)
    (found,) = gather_runs(tmp_path).runs
    assert not found.references  # those of one track alone are no match
    row = rows(build(gather_runs(tmp_path)), "runs")["a"]
    assert run.several is not None
    assert row["AIHTR"] == run.several.figures.aihtr.mean == tm.evaluate(targets, run).aihtr.mean
    assert row["upper bound"] is None
