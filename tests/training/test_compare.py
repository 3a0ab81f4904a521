"""Policies side by side: exact differences on a world, paired ones over held-out tracks."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import trackmdp as tm
from tests.helpers import small_world
from tests.tracks import by_hand, drawn, recorded
from trackmdp.app.cli import main
from trackmdp.errors import UserError
from trackmdp.notebook.card import MOST_LINES
from trackmdp.recordings.tracks import Recorded
from trackmdp.solvers.value import replay
from trackmdp.statistics import MeanInterval, mean_over_groups
from trackmdp.training.compare import FIGURES, Compared, Comparison
from trackmdp.training.evaluator import ESTIMATED, HeldOutEvaluator
from trackmdp.world.model import World

WORLD = small_world(exit_probability=0.05)
FEW = {"total_frames": 2000, "frames_per_batch": 1000, "envs": 50}


def test_differences_on_a_world_are_exact() -> None:
    found = tm.compare(WORLD, {"Q": "qmdp", "best": tm.solve(WORLD), "again": "qmdp"})
    q, best, again = found.policies
    values = [tm.evaluate(WORLD, name).aihtr for name in ("qmdp", "optimal")]
    assert (q.figures["aihtr"].mean, best.figures["aihtr"].mean) == pytest.approx(values)
    assert best.difference.mean == best.difference.low == pytest.approx(values[1] - values[0])
    assert (again.difference.mean, found.tracks) == (0.0, None)
    assert found.sentences == [
        f"best earns {values[1] - values[0]:,.3f} more per episode than Q (exact).",
        "again earns the same as Q (exact).",
    ]


def test_differences_on_tracks_are_paired_over_targets() -> None:
    """Each target's own difference: far narrower than the spread of the targets' rewards."""
    problem = recorded(drawn(WORLD.kernel, 200, 1), drawn(WORLD.kernel, 60, 2))
    clocked = tm.Policy.from_table(tm.solve(WORLD, "clocked").table)
    found = tm.compare(problem, {"none": "none", "clocked": clocked})
    none, other = found.policies
    reward = [
        replay(problem, problem.held_out, table).totals[:, 0]
        for table in (tm.Policy.none(problem), clocked)
    ]
    own = mean_over_groups([(reward[1] - reward[0]).tolist()])
    assert other.difference.mean == pytest.approx(own.mean)
    assert (other.difference.low, other.difference.high) == pytest.approx(
        (own.low, own.high), rel=0.15
    )
    assert found.tracks == 60
    assert (
        "clocked earns" in found.sentences[0] and "more per track than none" in found.sentences[0]
    )
    same = tm.compare(problem, {"a": clocked, "b": clocked})
    assert same.sentences == ["No difference between b and a is shown; all tracks agree."]
    assert (same.policies[1].difference.mean, same.policies[1].difference.low) == (0.0, None)
    assert none.difference.mean == 0.0


@pytest.mark.parametrize("problem", [WORLD, recorded(by_hand([0, 1, 2], [4, 3], [8, 7, 4]))])
def test_sets_in_an_array_are_a_policy(problem: World | Recorded) -> None:
    sets = tm.Policy.all_on(problem).dense()
    first, second = tm.compare(problem, ["all_on", sets]).policies
    assert first.figures == second.figures


@pytest.mark.parametrize("window", [None, 0])
def test_q_mdp_on_tracks_is_that_of_the_kernel_estimated_from_them(window: int | None) -> None:
    """As `train` and `evaluate` show it."""
    tracks = drawn(WORLD.kernel, 200, 1), drawn(WORLD.kernel, 60, 2)
    problem = recorded(*tracks, window=window)
    evaluator = HeldOutEvaluator(problem)
    shown = evaluator.held_out(tm.Policy.none(problem))["figures"][ESTIMATED]["aihtr"]["mean"]
    assert tm.compare(problem, ["qmdp", "none"]).policies[0].figures["aihtr"].mean == shown


def test_pieces_of_one_target_are_one_unit() -> None:
    tracks = by_hand([0, 1, 2, 5], [4, 3, 0], [8, 7, 4, 1], [1, 2, 5], [3, 4, 5])
    pieces = type(tracks)(tracks.cells, tracks.first, tracks.exits, np.array([7, 7, 7, 8, 8]))
    difference = tm.compare(recorded(pieces), ["none", "all_on"]).policies[1].difference
    assert (difference.n, difference.low) == (2, None)


def test_a_comparison_at_a_prompt_names_its_policies() -> None:
    shown = repr(tm.compare(WORLD, ["qmdp", tm.Policy.none(WORLD)]))
    assert shown.startswith("Comparison: 2 policies, exact")
    assert "qmdp" in shown and "Policy 2" in shown
    assert len(shown.splitlines()) <= MOST_LINES


def test_no_difference_is_cut_from_a_line() -> None:
    """All sensors on earns thousands less, with an interval as wide."""
    wide = MeanInterval(-1969.020, -2130.906, -1815.392, 30)
    values = (wide.mean, 1.0, 384.0)
    figures = {name: MeanInterval(x, x, x, 30) for name, x in zip(FIGURES, values, strict=True)}
    rows = tuple(Compared(name, figures, wide) for name in ("learned", "all sensors"))
    last = repr(Comparison(rows, 30)).splitlines()[-1]
    assert last.endswith("Δ -1,969.020 (-2,130.906 ... -1,815.392)") and "…" not in last


@pytest.mark.parametrize(
    ("policies", "message"),
    [
        (["qmdp"], "compare: 1 policies, expected at least two"),
        (["qmdp", "qmpd"], "compare: qmpd: baseline=qmpd: expected one of"),
        ({"mine": 3, "b": "qmdp"}, "compare: mine: policy: a int"),
        (["all_on", tm.Policy.none(small_world(4))], "compare: Policy 2: policy: made for 4 x 4"),
    ],
)
def test_a_policy_that_cannot_be_compared_is_named(policies: object, message: str) -> None:
    with pytest.raises(UserError) as caught:
        tm.compare(WORLD, policies)  # type: ignore[arg-type]
    assert str(caught.value).startswith(message)


def test_the_command_compares_runs_and_baselines(
    empty_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, world in (("a", WORLD), ("b", WORLD), ("c", small_world(exit_probability=0.1))):
        tm.train(world, "model_based", folder=name, **FEW)
    words = ["run=a", "run=b", "run=c", "baseline=none", "hydra.run.dir=out"]
    assert main(["compare", *words]) == 0
    shown = capsys.readouterr().out
    assert "b earns the same as a (exact)." in shown
    assert "c (other problem) earns" in shown
    written = json.loads((empty_folder / "out/comparison.json").read_text())
    assert [each["name"] for each in written["policies"]] == ["a", "b", "c (other problem)", "none"]
    assert written["policies"][0]["figures"]["aihtr"]["mean"] == pytest.approx(
        tm.load_run("a").evaluation.aihtr
    )


def test_a_run_with_the_name_of_a_baseline_is_not_replaced_by_it(empty_folder: Path) -> None:
    tm.train(WORLD, "model_based", folder="none", **FEW)
    words = ["run=none", "baseline=none", "hydra.run.dir=out", "quiet=true"]
    assert main(["compare", *words]) == 0
    first, second = json.loads((empty_folder / "out/comparison.json").read_text())["policies"]
    assert (first["name"], second["name"]) == (str(empty_folder / "none"), "none")
    assert first["figures"]["aihtr"] != second["figures"]["aihtr"]


@pytest.mark.usefixtures("empty_folder")
def test_a_run_on_another_grid_is_refused_in_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    tm.train(WORLD, "model_based", folder="a", **FEW)
    tm.train(small_world(4), "model_based", folder="b", **FEW)
    assert main(["compare", "run=a", "run=b"]) == 2
    said = "trackmdp compare: b (other problem): policy: made for 4 x 4 cells"
    assert capsys.readouterr().err.startswith(said)


@pytest.mark.usefixtures("empty_folder")
@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["baseline=qmdp"], "expected at least two policies"),
        (["baseline=qmdp", "baseline=qmpd"], "baseline=qmpd: expected one of"),
        (["run=x", "baseline=qmdp"], "run=/"),
        (["run=x", "run=y", "grid.size=4"], "grid.size=4: not together with run="),
        (["run=x", "run=y", "task.memory=cell"], "task.memory=cell: not together with run="),
        (["run=x", "run=x"], "expected at least two policies, run=FOLDER or baseline=NAME, got 1"),
        (["baseline=qmdp", "baseline=sets"], "baseline=sets: expected one of qmdp, all_on, none,"),
    ],
)
def test_a_mistyped_comparison_is_one_line(
    words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["compare", *words]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"trackmdp compare: {message}") and error.count("\n") == 1
