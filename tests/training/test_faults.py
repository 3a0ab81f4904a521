"""What breaks while a run is going on: it ends with one line, what was saved stands, and going on loses nothing."""

from __future__ import annotations

import gc
import multiprocessing
import os
import resource
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import torch

import trackmdp as tm
from tests.helpers import later, train_config
from tests.training.runs import (
    BUDGET,
    QUICK,
    SMALL,
    assert_same_run,
    at_iteration,
    breaks,
    rows,
    train,
)
from trackmdp import signals
from trackmdp.algos.common import make_algorithm
from trackmdp.app.prepare import Prepared
from trackmdp.errors import Preempted, RunError, UserError
from trackmdp.signals import Watch
from trackmdp.training import checkpoint, collect
from trackmdp.training.callbacks import Callback, Training
from trackmdp.training.lock import locked
from trackmdp.training.state import _weights
from trackmdp.world.configured import build_world


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Runs that nothing happened to."""
    folders = {algo: tmp_path_factory.mktemp("whole") / algo for algo in ("ppo", "hindsight")}
    for algo, folder in folders.items():
        train(folder, algo=algo)
    return folders


def saved(folder: Path) -> list[int]:
    """Iterations of the checkpoints, all of which can be read; nothing half-written lies about."""
    assert not list(folder.rglob("*.part"))
    return [
        checkpoint.load(file)["iteration"]
        for file in checkpoint.available_checkpoints(folder / "checkpoints")
    ]


def test_a_disk_that_fills_up_costs_nothing_but_a_call(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, whole: dict[str, Path]
) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    with monkeypatch.context() as patch:
        at_iteration(patch, 5, lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (4096, hard)))
        try:
            with pytest.raises(
                RunError, match="File too large; resume=auto resumes from the last checkpoint"
            ):
                train(tmp_path)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert saved(tmp_path) == [4, 3]
    train(tmp_path, "resume=auto")
    assert_same_run(tmp_path, whole["ppo"])


def test_a_disk_too_small_for_any_checkpoint(tmp_path: Path, whole: dict[str, Path]) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, hard))
    try:
        with pytest.raises(RunError, match="File too large"):
            train(tmp_path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert saved(tmp_path) == []
    train(tmp_path, "resume=auto")
    assert_same_run(tmp_path, whole["ppo"])


def test_a_disk_too_small_for_a_run_from_python(tmp_path: Path) -> None:
    world = tm.make_world("random_walk", size=3)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, hard))
    try:
        with pytest.raises(RunError, match=f"{tmp_path}.*: File too large; resume=auto"):
            tm.train(world, total_frames=100, frames_per_batch=100, envs=10, folder=tmp_path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_the_folder_is_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "run"
    at_iteration(monkeypatch, 3, lambda: shutil.rmtree(folder))
    folder.mkdir()
    ready = Prepared("train", train_config(*SMALL["ppo"], *QUICK, *BUDGET), folder)
    with pytest.raises(RunError, match=f"hydra.run.dir={folder}: the folder was removed"):
        ready.run()
    assert not folder.exists()


@pytest.mark.parametrize("algo", ["hindsight", *later(["ppo"])])
def test_a_loss_that_is_not_finite_names_the_iteration_and_leaves_the_last_good_state(
    algo: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, whole: dict[str, Path]
) -> None:
    cfg = train_config(*SMALL[algo], *QUICK, *BUDGET)
    learner = type(make_algorithm(cfg, build_world(cfg), torch.device("cpu")))
    step, bad = learner.step, 10 if algo == "hindsight" else 4

    def poisoned(self: Any, batch: Any) -> dict[str, float]:
        if poisoned.calls == bad - 1:
            with torch.no_grad():
                for _, weights in _weights(self.state_dict()):
                    weights.fill_(torch.nan)
        poisoned.calls += 1
        return step(self, batch)

    poisoned.calls = 0
    with monkeypatch.context() as patch:
        patch.setattr(learner, "step", poisoned)
        with pytest.raises(RunError, match=f"iteration {bad}: .* is nan"):
            train(tmp_path, algo=algo)
    assert saved(tmp_path) == ([8, 7] if algo == "hindsight" else [3, 2])
    train(tmp_path, "resume=auto", algo=algo)
    assert_same_run(tmp_path, whole[algo])


@pytest.mark.parametrize(
    ("number", "iteration"),
    [
        (signal.SIGTERM, 3),
        (signal.SIGINT, 3),
        (signal.SIGTERM, 8),
        *later([(signal.SIGUSR1, 3), (signal.SIGHUP, 3)]),
    ],
)
def test_a_signal_ends_the_run_after_its_iteration_is_saved(
    number: signal.Signals,
    iteration: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    whole: dict[str, Path],
) -> None:
    """The last one too: the optimum, which may take minutes, or a further block would come next."""
    before = signal.getsignal(number)
    with monkeypatch.context() as patch:
        at_iteration(patch, iteration, lambda: signal.raise_signal(number))
        with pytest.raises(Preempted) as told:
            train(tmp_path, "checkpoint.every=0")
    assert (told.value.signal, saved(tmp_path)) == (number, [iteration])
    assert signal.getsignal(number) == before
    train(tmp_path, "checkpoint.every=0", "resume=auto")
    assert_same_run(tmp_path, whole["ppo"])


class SignalsAtTheEnd(Callback):
    """As where a log is sent elsewhere, which takes long."""

    def on_end(self, trainer: Training) -> None:
        signal.raise_signal(signal.SIGTERM)


def test_a_signal_while_logs_are_closed_is_heard() -> None:
    world = tm.make_world("random_walk", size=3, cost=0.1)
    with pytest.raises(Preempted, match="signal 15"):
        tm.train(world, callbacks=[SignalsAtTheEnd()], total_frames=2000, frames_per_batch=1000)


def test_rows_written_after_the_checkpoint_are_cut_off(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, whole: dict[str, Path]
) -> None:
    with monkeypatch.context() as patch:
        at_iteration(patch, 5, breaks)
        with pytest.raises(RunError, match="Input/output error"):
            train(tmp_path, "checkpoint.every=512")
    assert saved(tmp_path) == [4, 2]
    assert len(rows(tmp_path)) == 5
    with (tmp_path / "metrics.csv").open("a") as stream:
        stream.write("6,1536,0.1")  # a row that was being written
    train(tmp_path, "checkpoint.every=512", "resume=auto")
    assert_same_run(tmp_path, whole["ppo"])


def test_one_process_per_folder(tmp_path: Path) -> None:
    with (
        locked(tmp_path),
        pytest.raises(UserError, match="another process is running in this folder"),
    ):
        train(tmp_path)
    assert not list(tmp_path.iterdir())
    train(tmp_path)


def while_collecting(patch: pytest.MonkeyPatch, action: Callable[[], Any]) -> None:
    """Do something just before the fourth batch is waited for."""
    check, calls = (
        Watch._check,
        iter([*range(6), None]),
    )  # two calls in each iteration: for the batch, for the weights

    def checked(self: Watch) -> None:
        check(self)
        if next(calls, 0) is None:
            action()

    patch.setattr(Watch, "_check", checked)


@pytest.mark.slow
def test_a_signal_to_the_workers_as_well_is_no_failure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def signal_all() -> None:
        signal.raise_signal(signal.SIGTERM)
        for worker in multiprocessing.active_children():
            os.kill(worker.pid or 0, signal.SIGTERM)

    with monkeypatch.context() as patch:
        while_collecting(patch, signal_all)
        with pytest.raises(Preempted) as told:
            train(tmp_path, "collector=multi_sync", "checkpoint.every=0")
    # They ignore it, so that the batch of iteration 4 comes in whole and is learned from before the run saves and ends.
    assert (told.value.signal, saved(tmp_path)) == (signal.SIGTERM, [4])


@pytest.mark.parametrize(
    ("collector", "when"), later([("multi_sync", "between"), ("multi_async", "while collecting")])
)
def test_a_worker_that_is_killed_is_named(
    collector: str, when: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def kill() -> None:
        os.kill(multiprocessing.active_children()[0].pid or 0, signal.SIGKILL)

    if when == "between":
        at_iteration(monkeypatch, 3, kill)
    else:
        while_collecting(monkeypatch, kill)
    with pytest.raises(
        RunError, match=r"iteration \d: collecting broke down \(worker [01] .*(SIGKILL|-9)"
    ):
        train(tmp_path, f"collector={collector}")
    for worker in multiprocessing.active_children():
        worker.join(
            60
        )  # TorchRL tells all of them to end, and waits ten seconds for it, too few on a busy machine
    assert not multiprocessing.active_children()
    assert saved(tmp_path)[0] >= 2
    monkeypatch.undo()
    train(tmp_path, f"collector={collector}", "resume=auto")
    assert saved(tmp_path)[0] == 8
    assert [int(row["iteration"]) for row in rows(tmp_path)] == list(range(1, 9))


def test_an_interruption_that_is_swallowed_comes_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(signals, "_AGAIN", 0.05)
    worker = multiprocessing.get_context("spawn").Process(target=time.sleep, args=(60,))
    worker.start()
    watch: Any = Watch([worker])
    with (
        watch,
        pytest.raises(RuntimeError, match="worker 0 was killed by SIGKILL"),
        watch.waiting(),
    ):
        with suppress(RuntimeError):
            worker.kill()
            threading.Event().wait(60)
        threading.Event().wait(60)


def dies(*_: Any) -> None:
    """In place of an environment."""
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.slow
def test_a_worker_that_does_not_start_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(collect, "_worker_env", dies)
    with pytest.raises(RunError) as told:
        train(tmp_path, "collector=multi_sync")
    line = str(told.value)
    assert line.startswith("collector=multi_sync: a worker did not start (")
    assert len(line.splitlines()) == 1


def told(*given: Any) -> Any:
    """An environment whose worker, while it starts, gets what a terminal or a scheduler sends to the whole group."""
    for number in (signal.SIGINT, signal.SIGUSR1):
        signal.raise_signal(number)
    os.kill(os.getppid(), signal.SIGUSR1)
    return collect.own_env(*given)


@pytest.mark.slow
def test_a_signal_while_workers_start_is_heard_once_they_have(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(collect, "_worker_env", told)
    with signals.handled(signals.stop, signal.SIGUSR1), pytest.raises(Preempted):
        train(tmp_path, "collector=multi_sync")
    assert "Traceback" not in capfd.readouterr().err
    for worker in multiprocessing.active_children():
        worker.join(60)
    assert not multiprocessing.active_children()


def test_a_worker_ends_with_the_learner_that_was_killed() -> None:
    code = """
import multiprocessing, threading
from trackmdp.solvers.workers import end_with_parent
def work():
    end_with_parent()
    print("ready", flush=True)
    threading.Event().wait()
worker = multiprocessing.get_context("fork").Process(target=work)
worker.start()
worker.join()
"""
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True
    ) as learner:
        assert learner.stdout is not None
        assert learner.stdout.readline() == "ready\n"
        learner.kill()
        # The worker holds the other end of the pipe, which is closed once it has ended too.
        assert learner.communicate(timeout=60)[0] == ""


@pytest.mark.parametrize(("mode", "step"), later([("kill", 23), ("power", 19), ("error", 21)]))
def test_a_run_that_ends_at_any_file_operation_resumes_to_the_same_run(
    mode: str, step: int, tmp_path: Path
) -> None:
    """Some of the points only; step 1 goes through all of them, in minutes."""
    words = [sys.executable, "-m", "tests.training.crashpoints", str(tmp_path), mode, str(step)]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    *failures, count = done.stdout.splitlines()
    assert not failures
    assert int(count.split()[0]) >= 3


class Held(Callback):
    """Open files, and bytes of all tensors that are alive, at each checkpoint."""

    def __init__(self) -> None:
        self.files: list[int] = []
        self.bytes: list[int] = []

    def on_checkpoint(self, trainer: Training, file: Path) -> None:
        gc.collect()
        # `type`, not `isinstance`: that asks an object of torch's own for its class, which warns.
        self.files.append(len(list(Path("/proc/self/fd").iterdir())))
        self.bytes.append(
            sum(found.nbytes for found in gc.get_objects() if issubclass(type(found), torch.Tensor))
        )


@pytest.mark.parametrize("algo", later(["ppo", "dqn"]))
def test_a_longer_run_holds_no_more_files_and_tensors(algo: str, tmp_path: Path) -> None:
    held = Held()
    options: dict[str, Any] = (
        {"buffer_size": 500, "batch_size": 64, "updates": 1} if algo == "dqn" else {}
    )
    options |= {"hidden": 16, "total_frames": 16 * 256, "frames_per_batch": 256, "envs": 32}
    options["checkpoint"] = {"every": 256, "seconds": None}
    world = tm.make_world("random_walk", size=3, cost=0.1)
    tm.train(world, algo, folder=tmp_path, callbacks=[held], **options)
    # From the tenth checkpoint on: until then the buffer fills, and the optimizer's state is made.
    assert len(held.files) >= 14
    assert max(held.files[10:]) <= held.files[9]
    assert max(held.bytes[10:]) <= held.bytes[9]
