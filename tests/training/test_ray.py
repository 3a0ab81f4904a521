"""Collecting in the workers of a Ray cluster; skipped where Ray is not installed."""

from __future__ import annotations

import os
import re
import signal
from pathlib import Path

import pytest

pytest.importorskip("ray", reason="ray is not installed")

from tests.app.commands.test_reads import OF_BLOCKS, SHORT, never_read
from tests.helpers import train_config
from tests.training.runs import at_iteration, rows
from trackmdp.app.commands.train import run
from trackmdp.errors import RunError, UserError
from trackmdp.training import on_ray
from trackmdp.training.on_ray import _Collector

pytestmark = pytest.mark.filterwarnings("ignore")  # Ray's own, of many kinds
WORDS = "algo=ppo collector=ray optimal.enabled=false " + SHORT


@pytest.mark.slow
def test_learns_from_the_frames_of_all_workers(tmp_path: Path) -> None:
    run(
        train_config(
            *WORDS.split(), "collector.total_frames=65536", "collector.frames_per_batch=4096"
        ),
        tmp_path,
    )
    first, last = rows(tmp_path)[0], rows(tmp_path)[-1]
    assert (int(first["frames"]), int(last["frames"])) == (4096, 65536)
    assert float(last["regret_per_step"]) < 0.9 * float(first["regret_per_step"])


@pytest.mark.long
def test_reads_every_option(tmp_path: Path) -> None:
    assert (
        never_read("train", f"{WORDS} optimal.enabled=true optimal.nodes=100000", tmp_path)
        == OF_BLOCKS
    )


@pytest.mark.slow
def test_a_worker_that_is_killed_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def kill() -> None:
        workers = [
            path for path in Path("/proc").iterdir() if path.name.isdigit() and _is_worker(path)
        ]
        os.kill(int(workers[0].name), signal.SIGKILL)

    at_iteration(monkeypatch, 2, kill)
    with pytest.raises(RunError, match="iteration 3: collecting broke down"):
        run(train_config(*WORDS.split(), "collector.total_frames=16384"), tmp_path)


def test_a_node_that_is_lost_while_weights_are_sent_is_named(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from ray.exceptions import ActorDiedError
    from torchrl.collectors.distributed import RayCollector

    def dies(*_: object, **__: object) -> None:
        raise ActorDiedError

    monkeypatch.setattr(RayCollector, "update_policy_weights_", dies)
    with pytest.raises(RuntimeError, match=r"^a worker was lost: [^\n]*$"):
        _Collector.__new__(_Collector).update_policy_weights_()


def test_workers_that_do_not_start_keep_no_cores(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Waited:
        def __init__(self, *_: object, **__: object) -> None:
            self.ended = False
            made.append(self)

        def update_policy_weights_(self) -> None:
            raise RuntimeError("wait timeout after 60000ms\nkeys: 1")

        def shutdown(self) -> None:
            self.ended = True

    made: list[Waited] = []
    monkeypatch.setattr(on_ray, "_Collector", Waited)
    with pytest.raises(
        RunError, match=r"^collector=ray: a worker did not start \(wait timeout after 60000ms\)$"
    ):
        run(train_config(*WORDS.split()), tmp_path)
    assert [each.ended for each in made] == [True]


def test_a_worker_that_is_killed_while_it_starts_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ray is told by an exception that is none of Python's own, of many lines; no Ray is started."""
    from ray.exceptions import RayActorError

    class Killed(_Collector):
        def __init__(self, *args: object, **options: object) -> None:
            raise RayActorError

        def __del__(self) -> None:
            pass

    monkeypatch.setattr(on_ray, "_Collector", Killed)
    message = r"^collector=ray: a worker did not start \(a worker was lost: [^\n]*\)$"
    with pytest.raises(RunError, match=message):
        run(train_config(*WORDS.split()), tmp_path)


@pytest.mark.long
def test_a_cluster_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="expected a Ray cluster"):
        run(train_config(*WORDS.split(), "collector.address=auto"), tmp_path)


def _is_worker(process: Path) -> bool:
    """Of the cluster that this process has started."""
    try:
        named = re.match(rb"ray::\w*Collector", (process / "cmdline").read_bytes())
        return named is not None and _parent(_parent(int(process.name))) == os.getpid()
    except OSError:
        return False


def _parent(process: int) -> int:
    return int(
        re.findall(r"^PPid:\t(\d+)$", Path(f"/proc/{process}/status").read_text(), re.MULTILINE)[0]
    )
