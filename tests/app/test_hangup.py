"""A lost connection or a closed terminal window: each command saves and ends as by a scheduler's signal."""

from __future__ import annotations

import fcntl
import os
import pty
import signal
import subprocess
import sys
import termios
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path

import pytest

from tests.app.commands.test_solve import members
from tests.typed import ENVIRONMENT
from trackmdp.signals import Signals, handled, stop
from trackmdp.terminal import outlast_terminal

TRAIN = (
    "algo=ppo grid.size=3 algo.total_frames=100_000_000 optimal.enabled=false checkpoint.every=0"
)


@contextmanager
def at_terminal(
    words: str, before: Callable[[], object] | None = None, errors: bool = True
) -> Iterator[tuple[subprocess.Popen[str], int]]:
    """A command at a terminal of its own, and our end of the terminal.

    Args:
        words: of the command.
        before: called in its process before it begins.
        errors: whether its errors go to a pipe, else they go to the terminal.
    """
    ours, theirs = pty.openpty()

    def control() -> None:
        fcntl.ioctl(theirs, termios.TIOCSCTTY, 0)
        if before is not None:
            before()

    with subprocess.Popen(
        [sys.executable, "-m", "trackmdp", *words.split()],
        stdin=theirs,
        stdout=theirs,
        stderr=subprocess.PIPE if errors else theirs,
        text=True,
        start_new_session=True,
        preexec_fn=control,
        env=ENVIRONMENT,
    ) as run:
        os.close(theirs)
        try:
            yield run, ours
        finally:
            with suppress(ProcessLookupError):
                os.killpg(run.pid, signal.SIGKILL)


def wait_for(pattern: str, run: subprocess.Popen[str], terminal: int) -> None:
    """Until there is such a file; what is shown meanwhile is taken, or the command would wait."""
    os.set_blocking(terminal, False)
    while run.poll() is None and not list(Path.cwd().rglob(pattern)):
        with suppress(BlockingIOError):
            os.read(terminal, 4096)


def hang_up(run: subprocess.Popen[str], terminal: int) -> str:
    """Close the terminal, and signal all processes as a shell does; what they say until the last has ended."""
    os.close(terminal)
    os.killpg(run.pid, signal.SIGHUP)
    said = run.stderr.read() if run.stderr else ""
    run.wait()
    return said


LINES = [
    f"train {TRAIN} hydra.run.dir=a",
    f"train {TRAIN} collector=multi_sync collector.workers=2 hydra.run.dir=a",
    pytest.param(f"train -m {TRAIN} seed=0,1 hydra.sweep.dir=a", marks=pytest.mark.long),
    f"train -m {TRAIN} seed=0,1 hydra.sweep.dir=a hydra/launcher=joblib",
]


@pytest.mark.slow
@pytest.mark.parametrize("line", LINES)
def test_training_saves(line: str, empty_folder: Path) -> None:
    with at_terminal(line) as (run, terminal):
        wait_for("metrics.csv", run, terminal)
        said = hang_up(run, terminal)
    assert (run.returncode, said) == (129, "trackmdp train: stopped by signal 1\n")
    assert list(empty_folder.rglob("iteration-*.pt"))
    assert not list(empty_folder.rglob("failed.json"))


@pytest.mark.slow
@pytest.mark.parametrize("nohup", [False, True])
def test_workers_end_or_go_on(nohup: bool, empty_folder: Path) -> None:
    size = "grid.size=6 partition.block=3" if nohup else "grid.size=60 partition.block=5"
    line = f"solve {size} grid.t_max=2 cost.sensor=0.22 partition.workers=2 hydra.run.dir=a"
    ignore = partial(signal.signal, signal.SIGHUP, signal.SIG_IGN)
    with at_terminal(line, before=ignore if nohup else None) as (run, terminal):
        while len(members(run.pid)) < 4 and run.poll() is None:
            pass
        said = hang_up(run, terminal)
    ended = (129, "trackmdp solve: stopped by signal 1\n")
    assert (run.returncode, said) == ((0, "") if nohup else ended)
    assert [file.name for file in empty_folder.rglob("solution.json")] == ["solution.json"] * nohup
    assert nohup or not list(empty_folder.iterdir())


@pytest.mark.slow
@pytest.mark.usefixtures("empty_folder")
def test_status_where_errors_go_to_the_terminal_too() -> None:
    with at_terminal(f"train {TRAIN} hydra.run.dir=a", errors=False) as (run, terminal):
        wait_for("metrics.csv", run, terminal)
        hang_up(run, terminal)
    assert run.returncode == 129


def test_where_it_is_ignored_it_stays_so() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with handled(stop, signal.SIGHUP), Signals() as signals:
            signal.raise_signal(signal.SIGHUP)
            assert not signals.received
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_what_is_printed_to_a_terminal_that_is_gone_is_dropped(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ours, theirs = pty.openpty()
    with os.fdopen(theirs, "w", encoding="utf-8") as stream:
        monkeypatch.setattr(sys, "stdout", stream)
        monkeypatch.setattr(sys, "stderr", stream)
        outlast_terminal()
        sys.stdout.write("shown\n")
        assert os.read(ours, 100) == b"shown\r\n"
        os.close(ours)
        sys.stdout.write("dropped\n")
        sys.stdout.flush()
