"""Sweeps on every launcher, each started as a user starts it; what is killed leaves the others as they are."""

from __future__ import annotations

import importlib.util
import os
import signal
import sys
import time
from pathlib import Path
from threading import Thread
from typing import Any

import pytest

from tests.app.sweep.runs import TINY, here, nothing_left, runs_of, started, states, swept, table
from tests.typed import stub
from trackmdp.app.cli import main
from trackmdp.errors import adding
from trackmdp.training.folders import run_of

__all__ = ["here", "nothing_left"]

SLOW = ("algo.updates=100000", "algo.updates_per_iteration=10", "checkpoint.seconds=null")
"""A run that goes on until it is stopped."""

needs = {
    name: pytest.mark.skipif(
        importlib.util.find_spec(name) is None, reason=f"{name} is not installed"
    )
    for name in ("joblib", "submitit", "ray")
}


@pytest.fixture(scope="module")
def basic(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sweep of four runs, the last of which is refused, one after the other."""
    folder = tmp_path_factory.mktemp("basic")
    finish(folder, "basic", status=2)
    return folder / "all"


def finish(folder: Path, launcher: str, *words: str, status: int = 0) -> str:
    """The sweep on `launcher`, to its end; what it said."""
    process = begin(folder, launcher, *words, "seed=0,1,2,-1")
    said, errors = process.communicate(timeout=300)
    assert process.returncode == status, errors
    return said


def begin(folder: Path, launcher: str, *words: str) -> Any:
    line = ["train", "-m", *TINY, f"hydra/launcher={launcher}", "hydra.sweep.dir=all"]
    return started(folder, *line, *words)


def holder(run: Path, sweep: Any) -> int:
    """The process that runs in a folder, once there is one; the sweep must not end before."""
    while sweep.poll() is None:
        for process in Path("/proc").iterdir():
            try:
                opened = (
                    [str(each.readlink()) for each in (process / "fd").iterdir()]
                    if process.name.isdigit()
                    else []
                )
            except OSError:
                continue
            if str(run / ".lock") in opened and int(process.name) != os.getpid():
                return int(process.name)
    raise AssertionError(f"nothing ran in {run}")


def wait_for(condition: Any, sweep: Any) -> None:
    """Until the condition holds, which it must before the sweep ends."""
    while not condition():
        assert sweep.poll() is None or condition()
        time.sleep(0.05)


LAUNCHERS = [
    pytest.param("joblib", ["hydra.launcher.n_jobs=2"], marks=needs["joblib"]),
    pytest.param("submitit_local", ["hydra.launcher.n_jobs=2"], marks=needs["submitit"]),
    pytest.param("ray", ["hydra.launcher.num_cpus=2"], marks=needs["ray"]),
]
OFTEN = [pytest.mark.slow, pytest.mark.long, pytest.mark.long]
"""What takes as long as all of them together is run by hand for the last two."""


@pytest.mark.slow
@pytest.mark.parametrize(("launcher", "words"), LAUNCHERS)
def test_every_launcher_has_the_results_of_the_basic_one(
    launcher: str, words: list[str], tmp_path: Path, basic: Path
) -> None:
    said = finish(tmp_path, launcher, *words, status=2)
    assert "3 done, 1 failed; all/runs.csv" in said
    assert (tmp_path / "all/runs.csv").read_bytes() == (basic / "runs.csv").read_bytes()


@pytest.mark.parametrize(
    ("launcher", "words"),
    [
        pytest.param("basic", [], marks=pytest.mark.slow),
        *(
            pytest.param(*item.values, marks=[*item.marks, often])
            for item, often in zip(LAUNCHERS, OFTEN, strict=True)
        ),
    ],
)
def test_a_run_that_is_killed_leaves_the_others(
    launcher: str, words: list[str], tmp_path: Path, basic: Path
) -> None:
    process = begin(
        tmp_path,
        launcher,
        *words,
        "seed=0,1,2,-1",
        "algo.updates=300",
        "algo.updates_per_iteration=1",
    )
    wait_for(lambda: (tmp_path / "all/sweep.json").is_file(), process)
    run = next(each.folder for each in runs_of(tmp_path / "all") if "seed=1" in each.overrides)
    os.kill(holder(run, process), signal.SIGKILL)
    _, said = process.communicate(timeout=300)
    assert states(tmp_path / "all") == ["done", "failed", "done", "failed"], said
    assert table(tmp_path / "all")[1]["reason"] == "killed by SIGKILL, perhaps for lack of memory"
    assert process.returncode == 1


@needs["submitit"]
@pytest.mark.slow
def test_slurm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, basic: Path) -> None:
    state = slurm(tmp_path, monkeypatch)
    words = [
        "hydra.launcher.partition=short",
        "hydra.launcher.mem_gb=2",
        "hydra.launcher.timeout_min=30",
    ]
    finish(tmp_path, "submitit_slurm", *words, status=2)
    assert (tmp_path / "all/runs.csv").read_bytes() == (basic / "runs.csv").read_bytes()
    script = (state / "script").read_text()
    for line in (
        "--array=0-3%4",
        "--partition=short",
        "--mem=2GB",
        "--time=30",
        "--cpus-per-task=1",
    ):
        assert f"#SBATCH {line}\n" in script
    assert "#SBATCH --signal=USR2@120\n" in script


@needs["submitit"]
@pytest.mark.slow
def test_a_preempted_run_saves_is_requeued_and_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    state = slurm(tmp_path, monkeypatch)
    words = [
        "algo.updates=400",
        "algo.updates_per_iteration=1",
        "checkpoint.seconds=null",
        "seed=0",
    ]
    process = begin(tmp_path, "submitit_slurm", *words)
    wait_for(lambda: (tmp_path / "all/sweep.json").is_file(), process)
    (run,) = runs_of(tmp_path / "all")
    wait_for(lambda: len(rows(run.folder)) > 2, process)
    os.kill(int((state / "4711.pid").read_text()), signal.SIGUSR2)
    _, said = process.communicate(timeout=300)
    assert process.returncode == 0, said
    assert (state / "requeued").read_text() == "4711\n"
    assert "resumes after iteration" in (run.folder / "output.txt").read_text()
    finish_one = ["train", *TINY, *words, "quiet=true", "hydra.run.dir=alone"]
    assert started(tmp_path, *finish_one).wait(timeout=300) == 0
    assert run_of(tmp_path / "alone").result["policy"] == run_of(run.folder).result["policy"]


def rows(folder: Path) -> list[str]:
    file = folder / "metrics.csv"
    return file.read_text().splitlines() if file.is_file() else []


def slurm(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Put a SLURM of this machine on the path; the folder of its state."""
    programs, state = folder / "bin", folder / "slurm"
    programs.mkdir()
    state.mkdir()
    source = Path(__file__).with_name("slurm.py").read_text()
    for name in ("sbatch", "srun", "sacct", "scontrol"):
        (programs / name).write_text(f"#!{sys.executable}\n{source}")
        (programs / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{programs}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("FAKE_SLURM", str(state))
    return state


SLOW_AND_LONG = [
    pytest.param("basic", marks=pytest.mark.slow),
    pytest.param("joblib", marks=[needs["joblib"], pytest.mark.long]),
]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("launcher", SLOW_AND_LONG)
def test_a_signal_stops_the_sweep_in_order(launcher: str, number: int, tmp_path: Path) -> None:
    process = begin(tmp_path, launcher, *SLOW, "seed=range(4)")
    wait_for(lambda: (tmp_path / "all/sweep.json").is_file(), process)
    first = runs_of(tmp_path / "all")[0].folder
    wait_for(lambda: len(rows(first)) > 1, process)
    process.send_signal(number)
    out, said = process.communicate(timeout=300)
    assert process.returncode == 128 + number
    assert said == f"trackmdp train: stopped by signal {number}\n"
    assert states(tmp_path / "all")[0] == "cut"
    assert "waiting; all/runs.csv" in out
    assert list(first.glob("checkpoints/iteration-*.pt"))
    assert not (tmp_path / "all/.stop").exists()


@pytest.mark.parametrize("launcher", SLOW_AND_LONG)
def test_a_sweep_killed_three_times_has_the_results_of_one_never_killed(
    launcher: str, tmp_path: Path
) -> None:
    words = [
        "seed=range(3)",
        "algo.updates=300",
        "algo.updates_per_iteration=1",
        "checkpoint.seconds=0.2",
    ]
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    for folder in (whole, cut):
        folder.mkdir()
    process = begin(whole, "basic", *words)
    process.communicate(timeout=300)
    assert process.returncode == 0
    for kill in range(3):
        process = begin(cut, launcher, *words)
        wait_for(lambda: (cut / "all/sweep.json").is_file(), process)
        run = runs_of(cut / "all")[kill].folder
        wait_for(lambda run=run: len(rows(run)) > 50 or run_of(run).state == "done", process)
        process.kill()
        process.communicate()
    process = begin(cut, launcher, *words)
    said, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors
    assert "of them done before" in said
    assert (cut / "all/runs.csv").read_bytes() == (whole / "all/runs.csv").read_bytes()


@pytest.mark.parametrize(
    ("launcher", "extra"), [("joblib", "sweep"), ("submitit_local", "slurm"), ("ray", "ray")]
)
def test_a_launcher_that_is_not_installed_names_its_extra(
    launcher: str,
    extra: str,
    here: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert swept("seed=0", f"hydra/launcher={launcher}") == 2
    said = capsys.readouterr().err
    assert said.startswith(f"trackmdp train: hydra/launcher={launcher}: needs ")
    assert said.endswith(f"which {adding(extra)} adds\n")
    assert not list(here.iterdir())


@needs["submitit"]
def test_slurm_is_refused_where_there_is_none(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PATH", str(here))
    assert swept("seed=0", "hydra/launcher=submitit_slurm") == 2
    assert capsys.readouterr().err.startswith(
        "trackmdp train: hydra/launcher=submitit_slurm: expected a machine from"
    )


def test_options_of_a_launcher_are_checked(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for words, message in (
        (
            "hydra/launcher=joblib hydra.launcher.n_jobs=0",
            "hydra.launcher.n_jobs=0: expected an integer from 1 to 1024",
        ),
        (
            "hydra/launcher=jobli",
            "hydra/launcher=jobli: expected one of basic, joblib, ray, submitit_local, ",
        ),
        ("hydra/sweeper=basic", "hydra/sweeper: expected one of blocks, optuna"),
        ("hydra/launcher=joblib hydra.launcher.jobs=2", "Could not override 'hydra.launcher.jobs'"),
    ):
        assert swept("seed=0", *words.split()) == 2
        assert capsys.readouterr().err.startswith(f"trackmdp train: {message}")
        assert not list(here.iterdir())


def test_what_a_broken_launcher_left_undone_is_launched_again(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from trackmdp.app.sweep import launchers

    calls = []

    def breaks(cfg: Any, jobs: Any) -> None:
        calls.append(len(jobs))
        launchers.run_job(jobs[0])
        raise OSError("the pool is gone")

    monkeypatch.setattr(launchers, "run_basic", breaks)
    stub(monkeypatch, "train", lambda cfg, folder: 1.0)
    assert swept("seed=range(5)", "quiet=true") == 1
    assert calls == [5, 4, 3]
    assert states(here / "all") == ["done", "done", "done", "failed", "failed"]
    assert table(here / "all")[4]["reason"] == "the launcher broke down: OSError: the pool is gone"


@pytest.mark.slow
def test_a_launcher_that_breaks_down_leaves_no_run_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else it would go on without its sweep, which could not launch it again, and wait for it at its end."""
    from trackmdp.app.sweep import launchers

    # With a fork server: where a thread of this process forks, `threading` may take another thread for the main one in
    # the child (Python 3.11, beside a thread of torch's shared tensors), which then hears no signal.
    monkeypatch.chdir(tmp_path)
    found, threads = [], []

    def breaks(cfg: Any, jobs: Any) -> None:
        for thread in threads:  # which sees that the run has ended, but not of itself
            thread.join()
        found.append([run_of(job.folder).state for job in jobs])
        if not threads:
            threads.append(Thread(target=launchers.run_job, args=(jobs[0],), daemon=True))
            threads[0].start()
            while not list(tmp_path.rglob("metrics.csv")):
                threads[0].join(0.05)
            raise OSError("the pool is gone")

    monkeypatch.setattr(launchers, "run_basic", breaks)
    assert swept(*SLOW, "quiet=true") == 1
    assert found == [["waiting"], ["cut"], ["cut"]]


def test_runs_have_the_threads_they_ask_for(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "7")

    def run(cfg: Any, folder: Path) -> float:
        return float(os.environ["OMP_NUM_THREADS"]) + 10 * float(os.environ["OPENBLAS_NUM_THREADS"])

    stub(monkeypatch, "train", run)
    assert main(["train", "-m", "threads=3", "quiet=true", "hydra.sweep.dir=all"]) == 0
    assert float(table(here / "all")[0]["aihtr"]) == 73.0
    assert "OMP_NUM_THREADS" not in os.environ
