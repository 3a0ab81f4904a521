"""How a command ends: on Ctrl-C, closed streams, a full disk, a breakdown."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.helpers import later
from tests.typed import ENVIRONMENT, refused, stub
from trackmdp.app import launch
from trackmdp.app.cli import main
from trackmdp.durable import write_json
from trackmdp.errors import Preempted, RunError, UserError
from trackmdp.signals import leave, stop
from trackmdp.solvers import optimal

pytestmark = pytest.mark.usefixtures("empty_folder")


def test_ctrl_c_ends_in_one_line_and_130(empty_folder: Path) -> None:
    code = """
import sys, types, threading
module = types.ModuleType("trackmdp.app.commands.train")
module.run = lambda *_: threading.Event().wait(60)
sys.modules[module.__name__] = module
from trackmdp.app.cli import main
from trackmdp.app.sweep.plan import sweep_name
sys.exit(main(["train"]))
"""
    process = subprocess.Popen(
        [sys.executable, "-c", code],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=ENVIRONMENT,
        # The tests may run in the background, where a shell has Ctrl-C ignored.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    assert process.stdout is not None
    assert process.stdout.readline().startswith("train ")
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=60)
    assert (process.returncode, said) == (130, "trackmdp train: interrupted\n")
    assert not list(empty_folder.iterdir())


@pytest.mark.parametrize("words", [["--version"], ["solve", "grid.size=0"]])
def test_closed_streams_are_no_mistake(words: list[str]) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "trackmdp", *words],
        env=ENVIRONMENT,
        preexec_fn=lambda: (os.close(1), os.close(2)),
        check=False,
    )
    assert done.returncode == (2 if "solve" in words else 0)


@pytest.mark.parametrize("sweep", [[], *later([["-m", "hydra.sweep.dir=all"]])])
def test_letters_that_a_terminal_lacks_are_no_mistake(sweep: list[str], empty_folder: Path) -> None:
    ascii_alone = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    words = ["evaluate", "baseline=none", "grid.size=3", "episodes=5", *sweep]
    done = subprocess.run(
        [sys.executable, "-m", "trackmdp.app.cli", *words],
        env=ENVIRONMENT | ascii_alone,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert "simulated ? s.e." in done.stdout  # ±


class Interrupted:
    def __set_name__(self, *_: object) -> None:
        raise KeyboardInterrupt


@pytest.mark.parametrize("moment", ["a class is made", "a config is composed"])
def test_ctrl_c_behind_another_error_is_one_line(
    moment: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*_: object) -> None:
        if moment == "a class is made":
            type("Config", (), {"option": Interrupted()})  # in Python 3.11 a RuntimeError
        try:
            raise KeyboardInterrupt
        finally:
            {}["half made"]

    monkeypatch.setattr(launch, "launch", interrupted)
    assert main(["solve"]) == 130
    assert capsys.readouterr() == ("", "trackmdp solve: interrupted\n")


def test_a_signal_behind_another_error_is_one_line_and_its_status(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As where OmegaConf is stopped while it composes."""

    def stopped(*_: object) -> None:
        try:
            leave(signal.SIGTERM, None)
        finally:
            {}["half made"]

    monkeypatch.setattr(launch, "launch", stopped)
    assert main(["solve"]) == 143
    assert capsys.readouterr() == ("", "trackmdp solve: interrupted\n")


def test_a_signal_that_interrupts_as_ctrl_c_does_has_its_own_status(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As where Ray waits for workers."""

    def stopped(*_: object) -> None:
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt:
            stop(signal.SIGTERM, None)

    monkeypatch.setattr(launch, "launch", stopped)
    assert main(["solve"]) == 143
    assert capsys.readouterr() == ("", "trackmdp solve: stopped by signal 15\n")


def test_errors_that_are_behind_each_other_are_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As those of a file of options that asks for code."""

    def fails(*_: object) -> None:
        first, second = UserError("first"), UserError("second")
        second.__context__ = first
        raise first from second

    monkeypatch.setattr(launch, "launch", fails)
    assert refused(capsys, "solve") == "first"


def interrupted(run: Any) -> None:
    raise KeyboardInterrupt


@pytest.mark.parametrize("kernel", ["random_support", "heading"])
@pytest.mark.parametrize("command", ["evaluate", "compare"])
def test_ctrl_c_in_the_search_for_a_baseline_writes_nothing(
    command: str,
    kernel: str,
    monkeypatch: pytest.MonkeyPatch,
    empty_folder: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(optimal._Run, "search", interrupted)
    baselines = ["baseline=optimal", *(["baseline=none"] if command == "compare" else [])]
    words = [*baselines, f"kernel={kernel}", "grid.size=3", "quiet=true"]
    assert main([command, *words, "hydra.run.dir=a"]) == 130
    assert capsys.readouterr() == ("", f"trackmdp {command}: interrupted\n")
    assert not list(empty_folder.iterdir())


@pytest.mark.parametrize("words", [["algo=model_based"], ["algo=a2c", "targets.count=2"]])
def test_ctrl_c_in_the_search_after_training_leaves_a_run_to_resume(
    words: list[str],
    monkeypatch: pytest.MonkeyPatch,
    empty_folder: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    frames = ["algo.total_frames=64", "algo.frames_per_batch=64", "algo.envs=8"]
    wide = ["evaluation.width=9"] if "targets.count=2" in words else []
    world = ["grid.size=2", "kernel=random_walk", "kernel.exit_probability=0.5"]
    line = ["train", *words, *frames, *wide, *world, "quiet=true", "hydra.run.dir=a", "resume=auto"]
    with monkeypatch.context() as cut:
        cut.setattr(optimal._Run, "search", interrupted)
        assert main(line) == 130
    assert capsys.readouterr() == ("", "trackmdp train: interrupted\n")
    assert not (empty_folder / "a/summary.json").exists()
    assert main(line) == 0
    assert (empty_folder / "a/summary.json").is_file()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="has no /dev/full")
@pytest.mark.parametrize(
    "words",
    [
        "solve grid.size=4",
        "train --help",
        *later(["train --cfg all", "train --help all", "train --info all"]),
    ],
)
def test_a_full_disk_under_standard_output_is_one_line(words: str, empty_folder: Path) -> None:
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "trackmdp.app.cli", *words.split()],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            env=ENVIRONMENT,
            check=False,
        )
    line = f"trackmdp: standard output: {os.strerror(errno.ENOSPC)}\n"
    assert (done.returncode, done.stderr) == (1, line)
    assert not list(empty_folder.iterdir())


@pytest.mark.parametrize(
    ("error", "status", "line"),
    [
        (RunError("iteration 3: the loss is not finite"), 1, "iteration 3: the loss is not finite"),
        (Preempted(signal.SIGTERM), 143, "stopped by signal 15"),
        (SystemExit(143), 143, "stopped by signal 15"),
        (MemoryError(), 1, "not enough memory"),
        (RuntimeError("[enforce fail] can't allocate memory: 8 bytes"), 1, "not enough memory"),
        (ImportError("libtorch_cpu.so: failed to map segment"), 1, "not enough memory"),
    ],
)
def test_a_run_that_breaks_down_ends_in_one_line(
    error: BaseException,
    status: int,
    line: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def run(cfg: Any, folder: Path) -> None:
        raise error

    stub(monkeypatch, "train", run)
    assert main(["train"]) == status
    assert capsys.readouterr().err == f"trackmdp train: {line}\n"


@pytest.mark.parametrize("own", [0, 200, "words"])
def test_the_status_of_a_plugin_that_ends_the_program_is_its_own(
    own: int | str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(cfg: Any, folder: Path) -> None:
        sys.exit(own)

    stub(monkeypatch, "train", run)
    with pytest.raises(SystemExit) as ended:
        main(["train"])
    assert (ended.value.code, capsys.readouterr().err) == (own, "")


def test_on_windows_one_line_says_where_it_runs(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("platform.system", lambda: "Windows")
    assert "Linux in WSL" in refused(capsys, "train")


def test_a_current_folder_that_was_removed_is_named(
    empty_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    empty_folder.rmdir()
    try:
        assert main(["solve", "grid.size=3"]) == 2
    finally:
        os.chdir(empty_folder.parent)
    (line,) = capsys.readouterr().err.splitlines()
    assert "current folder" in line


def test_a_folder_that_is_removed_meanwhile_is_named(
    monkeypatch: pytest.MonkeyPatch, empty_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(cfg: Any, folder: Path) -> None:
        folder.rmdir()
        write_json(folder / "solution.json", {})

    stub(monkeypatch, "solve", run)
    assert main(["solve", "hydra.run.dir=a"]) == 1
    line = f"hydra.run.dir={empty_folder / 'a'}: the folder was removed while the run wrote to it"
    assert capsys.readouterr().err == f"trackmdp solve: {line}\n"
    assert not list(empty_folder.iterdir())
