"""A sweep that ends early, or whose parts do: a refused launcher, a signal, a dead fork server."""

from __future__ import annotations

import errno
import os
import signal
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from tests.app.sweep.runs import TINY, here, started, states, swept
from tests.typed import stub
from trackmdp.app.sweep import process
from trackmdp.app.sweep.plan import Job
from trackmdp.app.sweep.process import stop_signal
from trackmdp.app.sweep.sweep import sweep
from trackmdp.config.compose import compose
from trackmdp.errors import Preempted, RunError, UserError
from trackmdp.signals import Signals
from trackmdp.training.folders import run_of

__all__ = ["here"]


def test_a_launcher_that_is_refused_is_not_asked_again(tmp_path: Path) -> None:
    asked: list[str] = []

    def launch(jobs: Sequence[Job]) -> None:
        asked.extend(job.name for job in jobs)
        raise UserError("hydra.launcher.address=x:1: expected a Ray cluster")

    with pytest.raises(UserError, match="expected a Ray cluster"):
        sweep(
            tmp_path,
            "train",
            "a line",
            [[Job("train", tmp_path, "one", (), None)]],
            launch,
            Console(quiet=True),
        )
    assert asked == ["one"]


def test_a_signal_is_told_to_the_runs_and_ends_the_sweep(tmp_path: Path) -> None:
    one, two = (Job("train", tmp_path, name, (), None) for name in ("one", "two"))
    before, seen = signal.getsignal(signal.SIGTERM), []

    def launch(jobs: Sequence[Job]) -> None:
        signal.raise_signal(signal.SIGTERM)
        seen.append(
            (
                [job.name for job in jobs],
                stop_signal(tmp_path),
                signal.getsignal(signal.SIGTERM) == before,
            )
        )

    with pytest.raises(Preempted) as told:
        sweep(tmp_path, "train", "a line", [[one], [two]], launch, Console(quiet=True))
    assert seen == [(["one"], signal.SIGTERM, False)]  # a second one is taken as well
    assert (told.value.signal, stop_signal(tmp_path), signal.getsignal(signal.SIGTERM)) == (
        signal.SIGTERM,
        0,
        before,
    )
    assert states(tmp_path) == ["waiting"]


def test_a_fork_server_that_loads_does_not_hear_the_signals_of_its_group(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Ctrl-C while it imports torch would end it with a traceback; the sweep hears it."""
    blocked: list[set[int]] = []

    def begins() -> None:
        blocked.append(signal.pthread_sigmask(signal.SIG_BLOCK, []))
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(process.forkserver, "ensure_running", begins)
    with Signals() as sweeping:
        process.context_for("train")
    assert blocked[0] >= {signal.SIGINT, signal.SIGTERM, signal.SIGUSR1}
    assert sweeping.received == signal.SIGTERM


class Told(Job):
    """A run that is asked to stop as soon as its process is there, before it can do anything."""

    def __reduce__(self) -> Any:
        return _told, (self.sweep, self.cfg)


def _told(sweep: Path, cfg: Any) -> Job:
    os.kill(os.getpid(), signal.SIGTERM)
    return Job("train", sweep, "one", (), cfg)


@pytest.mark.slow
def test_a_run_hears_what_came_while_its_process_began(tmp_path: Path) -> None:
    (tmp_path / "one").mkdir()
    cfg = compose("train", {"grid.size": 3, "quiet": True, "algo.total_frames": 10_000})
    assert process.run_in_process(Told("train", tmp_path, "one", (), cfg)) == -signal.SIGTERM
    assert not list((tmp_path / "one").iterdir())


def test_a_run_whose_process_cannot_start_is_told_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def no_memory(job: Job) -> None:
        raise OSError(errno.ENOMEM, "Cannot allocate memory")

    monkeypatch.setattr(process, "_start", no_memory)
    job = Job("train", tmp_path, "one", (), compose("train", {}))
    process.run_job(job)
    assert run_of(job.folder).state == "failed"
    assert capsys.readouterr().err.count("could not be started") == 1


def test_a_run_that_cannot_leave_its_reason_is_told_in_a_line(
    here: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """On a full disk, which would be as full at a second attempt."""

    def run(cfg: Any, folder: Path) -> None:
        raise RunError("the disk is full")

    def full(file: Path, content: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(file))

    stub(monkeypatch, "train", run)
    monkeypatch.setattr(process, "write_json", full)
    assert swept("seed=0", "quiet=true") == 1
    said = capfd.readouterr().err
    assert "Traceback" not in said
    assert " failed: " in said
    assert said.endswith(f"failed.json: {os.strerror(errno.ENOSPC)}\n")
    assert said.count(" failed: ") == 1


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc").is_dir(), reason="needs /proc")
def test_runs_outlive_their_fork_server(here: Path) -> None:
    more = ["collector.total_frames=200_000", "seed=0,1", "hydra.sweep.dir=all"]
    process = started(
        here, "train", "-m", *(word for word in TINY if "total_frames" not in word), *more
    )
    for run in range(2):  # the server is killed while each of the two runs goes on
        until = time.monotonic() + 120
        while len(list((here / "all").glob("*/config.yaml"))) <= run and time.monotonic() < until:
            time.sleep(0.02)
        servers = [
            int(path.parent.name)
            for path in Path("/proc").glob("[0-9]*/cmdline")
            if b"forkserver import main" in path.read_bytes()
            and _parent(path.parent) == process.pid
        ]
        assert len(servers) == 1
        os.kill(servers[0], signal.SIGKILL)
    _, said = process.communicate(timeout=240)
    assert (process.returncode, said) == (0, "")
    assert states(here / "all") == ["done", "done"]


def _parent(process: Path) -> int:
    return int((process / "stat").read_text().rpartition(")")[2].split()[1])
