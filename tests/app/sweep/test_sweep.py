"""A sweep as a user types it: what it leaves, skips, retries and says."""

from __future__ import annotations

import errno
import io
import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from tests.app.sweep.runs import ROOT, TINY, here, runs_of, states, swept, table
from tests.typed import stub
from trackmdp.app.cli import main
from trackmdp.app.sweep.sweep import show_runs, write_table
from trackmdp.durable import write_sealed
from trackmdp.errors import Preempted, RunError
from trackmdp.reports.gather import planned
from trackmdp.training.folders import RunState, run_of, write_plan
from trackmdp.training.lock import locked

__all__ = ["here"]


def test_the_same_line_again_skips_what_is_done_and_imports_nothing_heavy(here: Path) -> None:
    line = ["train", "-m", *TINY, "seed=0,1"]
    assert main(line) == 0
    (sweep,) = (here / "multirun").iterdir()
    for row, seed in zip(table(sweep), "01", strict=True):
        summary = json.loads((sweep / row["folder"] / "summary.json").read_text())
        assert (row["seed"], row["state"], row["grid.size"]) == (seed, "done", "3")
        assert float(row["aihtr"]) == summary["policy"]["aihtr"]
        assert float(row["regret_per_step"]) == summary["regret_per_step"]
        assert int(row["frames"]) == 2048
    before = {file: file.stat().st_mtime_ns for file in sweep.rglob("*") if file.is_file()}
    first = (sweep / "runs.csv").read_bytes()
    code = f"""
import sys
from trackmdp.app.cli import main
status = main({line})
sys.exit(str((status, sorted({{"torch", "torchrl", "scipy"}} & set(sys.modules)))))
"""
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    again = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=False
    )
    assert again.stderr == "(0, [])\n"
    assert "2 runs, 2 of them done before -> multirun/train-" in again.stdout
    assert "2 skipped; " in again.stdout
    assert (sweep / "runs.csv").read_bytes() == first
    after = {file: file.stat().st_mtime_ns for file in sweep.rglob("*") if file.is_file()}
    assert {file.name for file in after if after[file] != before.get(file)} == {
        "sweep.json",
        "runs.csv",
    }


def test_a_run_of_a_sweep_is_the_run_typed_alone(here: Path) -> None:
    assert swept("seed=3", "quiet=true") == 0
    assert main(["train", *TINY, "seed=3", "quiet=true", "hydra.run.dir=alone"]) == 0
    (row,) = table(here / "all")
    assert (
        float(row["aihtr"])
        == json.loads((here / "alone/summary.json").read_text())["policy"]["aihtr"]
    )


def test_a_mistake_in_every_run_is_told_once_and_leaves_nothing(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert swept("seed=0,1", "resume=somewhere") == 2
    assert re.fullmatch(
        r"trackmdp train: resume=.*somewhere: expected null or auto [^\n]*\n",
        capsys.readouterr().err,
    )
    assert not list(here.iterdir())


@pytest.mark.parametrize("resume", ["null", "auto"])
def test_an_option_without_effect_is_told_with_resume_as_well(
    resume: str, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The words of a run in a sweep are all of its own config, also where it goes on."""
    assert swept("seed=0,1", "algo=dqn", "algo.prioritized.alpha=0.5", f"resume={resume}") == 2
    assert "algo.prioritized.alpha=0.5: without effect" in capsys.readouterr().err
    assert not list(here.iterdir())


def test_an_option_of_the_choices_of_a_sweep_needs_not_be_one_of_the_default(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    stub(monkeypatch, "train", lambda cfg, folder: 1.0)
    assert swept("sensor=miss,footprint", "sensor.p_d=0.9") == 0
    assert states(here / "all") == ["done", "done"]
    assert swept("sensor=perfect,perfect", "sensor.p_d=0.9") == 2
    assert "sensor.p_d: an option of another choice" in capsys.readouterr().err


def test_a_mistake_in_one_run_is_told_and_the_others_go_on(
    here: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    stub(monkeypatch, "train", lambda cfg, folder: 1.0)
    assert swept("grid.size=3,0,4,-1") == 2
    assert states(here / "all") == ["done", "failed", "done", "failed"]
    captured = capfd.readouterr()
    reason = "grid.size=0: expected an integer >= 1, or a pair of them (cells)"
    said = captured.err.splitlines()
    assert said[0].startswith("trackmdp train: size_0-")
    assert said[0].endswith(f" failed: {reason}")
    assert said[-1] == "trackmdp train: 2 of 4 runs failed"
    assert "2 done, 2 failed; all/runs.csv" in captured.out
    failed = runs_of(here / "all")[1]
    assert (failed.state, failed.reason) == ("failed", reason)
    assert [path.name for path in failed.folder.iterdir()] == ["failed.json"]


def raised(error: BaseException) -> None:
    raise error


ENDS: list[tuple[Callable[[], Any], str]] = [
    (lambda: sys.exit(3), "SystemExit: 3"),
    (lambda: os._exit(3), "its process ended with status 3"),
    (lambda: os.kill(os.getpid(), signal.SIGKILL), "killed by SIGKILL, perhaps for lack of memory"),
    (
        lambda: raised(RunError("iteration 3: the loss\nis not finite")),
        "iteration 3: the loss is not finite",
    ),
    (lambda: raised(Preempted(15)), "stopped by signal 15"),
    (lambda: raised(OSError(errno.ENOSPC, "no space", "a.json")), "a.json: no space"),
    (lambda: raised(MemoryError()), "MemoryError"),
    (lambda: raised(ZeroDivisionError("a bug")), "ZeroDivisionError: a bug"),
]


def test_nothing_that_ends_a_run_ends_the_others(
    here: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def run(cfg: Any, folder: Path) -> float:
        if cfg.seed < len(ENDS):
            ENDS[cfg.seed][0]()
        return float(cfg.seed)

    stub(monkeypatch, "train", run)
    assert swept(f"seed=range({len(ENDS) + 1})", "quiet=true") == 1
    assert states(here / "all") == ["failed"] * len(ENDS) + ["done"]
    assert [row["reason"] for row in table(here / "all")] == [*(reason for _, reason in ENDS), ""]
    # Of what is none of our errors: SystemExit and the last two.
    assert capfd.readouterr().err.count("Traceback") == 3


def test_a_failed_run_is_retried(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        stub(patch, "train", lambda cfg, folder: 1 / cfg.seed)
        assert swept("seed=0,1", "quiet=true") == 1
    assert states(here / "all") == ["failed", "done"]
    stub(monkeypatch, "train", lambda cfg, folder: 1.0)
    assert swept("seed=0,1", "quiet=true") == 0
    assert states(here / "all") == ["done", "done"]
    assert not list(here.rglob("failed.json"))


def test_the_summary_of_another_config_does_not_count(here: Path) -> None:
    assert swept("seed=0", "quiet=true") == 0
    (run,) = runs_of(here / "all")
    summary = json.loads((run.folder / "summary.json").read_text())
    (run.folder / "summary.json").write_text(
        json.dumps(summary | {"config_sha256": "0", "policy": {"aihtr": 7.0}})
    )
    assert swept("seed=0", "quiet=true") == 0
    assert json.loads((run.folder / "summary.json").read_text())["policy"] == summary["policy"]


def test_blocks_of_an_experiment_are_the_sweep(
    here: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    stub(monkeypatch, "train", lambda cfg, folder: 1.0)
    (here / "mine/experiment").mkdir(parents=True)
    (here / "mine/experiment/few.yaml").write_text(
        "# @package _global_\ngrid: {size: 3}\nalgo: {rounds: 4}\n"
        "collector: {total_frames: 2048, frames_per_batch: 1024, envs: 64}\n"
        "hydra: {sweeper: {blocks: ['kernel.support_size=3 seed=0,1', 'kernel.support_size=4 kernel.seed=7']}}\n"
    )
    line = ["train", "-m", "--config-dir", "mine", "experiment=few"]
    assert main([*line, "quiet=true"]) == 0
    (sweep,) = (here / "multirun").iterdir()
    assert sweep.name.startswith("few-")
    assert [row["folder"].rpartition("-")[0] for row in table(sweep)] == [
        "support_size_3-seed_0",
        "support_size_3-seed_1",
        "support_size_4-seed_7",
    ]
    assert main(line) == 0
    assert f"3 runs -> multirun/{sweep.name}" in capfd.readouterr().out
    assert main([*line, "grid.sise=3"]) == 2
    assert capfd.readouterr().err.startswith(
        "trackmdp train: grid.sise: unknown option, did you mean grid.size?"
    )
    assert main([*line[:-1], "experiment=fwe"]) == 2
    assert (
        capfd.readouterr().err == "trackmdp train: experiment=fwe: expected one of few, growth, "
        "model_based, pairs, paper, quality\n"
    )


def test_the_plan_is_on_disk_before_the_first_run(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run(cfg: Any, folder: Path) -> float:
        (folder / "config.yaml").touch()
        with locked(folder):
            shown = runs_of(folder.parent)
        assert [each.state for each in shown] == (
            ["running", "waiting"] if cfg.seed == 0 else ["done", "running"]
        )
        return 1.0

    stub(monkeypatch, "train", run)
    assert swept("seed=0,1", "quiet=true") == 0
    content = json.loads((here / "all/sweep.json").read_text())
    assert content["command"] == "train"
    assert content["line"].startswith("trackmdp train -m grid.size=3 ")
    assert [job["overrides"][-2] for job in content["jobs"]] == ["seed=0", "seed=1"]


def test_a_plan_of_the_most_runs_is_read_back(tmp_path: Path) -> None:
    """As many bytes as 100,000 runs take, in fewer runs."""
    write_plan(
        tmp_path,
        "train",
        "trackmdp train -m",
        [(str(place), ["x=" + "y" * 20_000]) for place in range(1_000)],
    )
    assert (tmp_path / "sweep.json").stat().st_size > 100_000 * 200
    plan = planned(tmp_path)
    assert plan is not None
    assert len(plan["jobs"]) == 1_000


def test_a_sweep_that_is_running_is_not_started_twice(
    here: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (here / "all").mkdir()
    with locked(here / "all"):
        assert swept("seed=0", "quiet=true") == 2
    assert capfd.readouterr().err == (
        f"trackmdp train: hydra.sweep.dir={here / 'all'}: another process is running in this folder\n"
    )


def test_another_command_has_its_value_in_the_table(here: Path) -> None:
    line = [
        "evaluate",
        "-m",
        "grid.size=3",
        "baseline=qmdp,none",
        "episodes=0",
        "quiet=true",
        "hydra.sweep.dir=all",
    ]
    assert main(line) == 0
    exact = [
        json.loads((run.folder / "evaluation.json").read_text())["exact"]
        for run in runs_of(here / "all")
    ]
    assert [float(row["aihtr"]) for row in table(here / "all")] == [each["aihtr"] for each in exact]


def test_a_command_without_a_value_has_none_in_the_table(here: Path) -> None:
    line = ["compare", "-m", "baselines=[qmdp,none]", "quiet=true", "hydra.sweep.dir=all"]
    assert main([*line, "grid.size=3,4"]) == 0
    assert [(row["state"], row["aihtr"]) for row in table(here / "all")] == [("done", "")] * 2


def test_states_of_a_run(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    assert run_of(folder).state == "waiting"
    folder.mkdir()
    (folder / "config.yaml").touch()
    assert run_of(folder).state == "cut"
    with locked(folder):
        assert run_of(folder).state == "running"
    (folder / "failed.json").write_text('{"reason": "no luck"}')
    assert (run_of(folder).state, run_of(folder).reason) == ("failed", "no luck")
    (folder / "summary.json").write_text('{"policy": {}}')  # not as a run seals it
    assert run_of(folder).state == "failed"
    write_sealed(folder / "summary.json", {"policy": {}})
    assert run_of(folder).state == "done"


def test_the_table_holds_no_formulas(tmp_path: Path) -> None:
    """A name that a spreadsheet would compute is kept as text; numbers, negative ones too, stay as they are."""
    run = RunState(
        tmp_path / "=1+1", ("kernel.direction=-90", "init_from=@home"), "failed", "+no luck"
    )
    write_table(tmp_path, [run])
    (row,) = table(tmp_path)
    assert (row["folder"], row["reason"]) == ("'=1+1", "'+no luck")
    assert (row["kernel.direction"], row["init_from"]) == ("-90", "'@home")


def test_runs_on_recordings_are_compared_by_the_validation_tracks(tmp_path: Path) -> None:
    parts = ({"aihtr": 8.0, "accuracy": 0.7, "sensors_per_step": 3.0}, {"aihtr": 9.0})
    result = dict(zip(("policy", "validation"), parts, strict=True)) | {"frames": 10}
    run = RunState(tmp_path / "a-0", ("seed=0",), "done", result=result)
    write_table(tmp_path, [run])
    (row,) = table(tmp_path)
    assert (row["aihtr"], row["held_out_aihtr"], row["held_out_accuracy"]) == ("9.0", "8.0", "0.7")
    out = io.StringIO()
    show_runs(Console(file=out, width=120), [run], [], tmp_path)
    assert "validation AIHTR" in out.getvalue()
    assert "9.000" in out.getvalue() and "8.000" not in out.getvalue()


def test_a_run_without_words_of_its_own_is_shown_by_its_digest(tmp_path: Path) -> None:
    out = io.StringIO()
    runs = [RunState(tmp_path / name, (), "done") for name in ("161d8da3", "seed_1-0a1b2c3d")]
    show_runs(Console(file=out, width=120), runs, [], tmp_path)
    assert "161d8da3" in out.getvalue() and "seed_1" in out.getvalue()


def test_runs_of_several_targets_are_compared_by_all_of_them_together(tmp_path: Path) -> None:
    figures = {"aihtr": {"mean": 19.0}, "accuracy": {"mean": 0.9}, "sensors_per_step": {"mean": 2}}
    several = {"figures": figures, "upper": 20.0, "expected_length": 10.0}
    single = {"policy": {"aihtr": 11.0, "accuracy": 0.8}, "regret_per_step": 0.0, "frames": 10}
    write_table(
        tmp_path, [RunState(tmp_path / "a-0", (), "done", result=single | {"several": several})]
    )
    (row,) = table(tmp_path)
    found = (row["aihtr"], row["regret_per_step"], row["accuracy"], row["sensors_per_step"])
    assert found == ("19.0", "0.1", "0.9", "2")
