"""What a run needs of the memory is known before it is taken."""

from __future__ import annotations

import ctypes
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.helpers import algorithm, collect, small_world, train_config
from trackmdp.algos.dqn import DQN
from trackmdp.app.cli import main
from trackmdp.config.learning import DqnConfig
from trackmdp.errors import UserError
from trackmdp.machine import free_bytes
from trackmdp.training.devices import check_memory, needs
from trackmdp.world.group import Group

CPU = torch.device("cpu")


def nbytes(state: Any) -> int:
    if isinstance(state, dict):
        return sum(map(nbytes, state.values()))
    return state.nbytes if isinstance(state, torch.Tensor) and state.dim() else 0


def system(root: Path, free: int, **cgroup: str) -> Path:
    (root / "proc").mkdir()
    (root / "sys/fs/cgroup").mkdir(parents=True)
    (root / "proc/meminfo").write_text(f"MemTotal: 99 kB\nMemAvailable:    {free} kB\n")
    for name, text in cgroup.items():
        (root / "sys/fs/cgroup" / name.replace("_", ".", 1)).write_text(text)
    return root


@pytest.mark.parametrize(
    "words",
    [
        ("algo=model_based", "cost.budget=2"),
        ("algo=model_based", "algo.sensing=chosen", "grid.window=1"),
        ("algo=hindsight", "algo.collect=mixed"),
    ],
)
def test_a_table_that_is_renewed_takes_what_was_estimated(words: tuple[str, ...]) -> None:
    cfg = train_config("grid.size=4", *words)
    task = small_world(size=4).but(budget=cfg.cost.budget, window=cfg.grid.window)  # type: ignore[attr-defined]
    learner = algorithm(words[0].partition("=")[2], task, *words[1:])
    assert needs(cfg, task.task)["grid.size"] == learner.policy.bits.nbytes
    assert not needs(train_config("grid.size=4", words[0]), task.task).get("grid.size")


@pytest.mark.parametrize("prioritized", [True, False])
@pytest.mark.parametrize(("t_max", "window"), [(0, None), (2, None), (2, 1)])
def test_the_replay_buffer_takes_what_was_estimated(
    prioritized: bool, t_max: int, window: int | None
) -> None:
    world = replace(small_world(size=4, t_max=t_max), window=window)
    words = (
        "algo=dqn",
        "algo.buffer_size=3000",
        "algo.updates=1",
        f"algo.prioritized.enabled={prioritized}",
    )
    words += (f"grid.window={'null' if window is None else window}",)
    cfg = train_config(
        *words, "algo.batch_size=64", "algo.envs=16", "collector.frames_per_batch=256"
    )
    assert isinstance(cfg.algo, DqnConfig)
    learner = DQN(world.task, cfg.algo, iterations=1, seed=0, device=CPU)
    learner.step(collect(world, learner.policy, 16, 4))
    held = learner.state_dict()["buffer"]
    del held["_rng"]
    assert needs(cfg, world.task)["algo.buffer_size"] == nbytes(held)


def test_the_replay_buffer_of_several_targets_takes_what_was_estimated() -> None:
    group = Group([small_world()] * 3)
    words = ("targets.count=3", "algo=dqn", "algo.buffer_size=3000", "algo.updates=1")
    cfg = train_config(
        *words, "algo.batch_size=64", "algo.envs=16", "collector.frames_per_batch=256"
    )
    assert isinstance(cfg.algo, DqnConfig)
    learner = DQN(group.task, cfg.algo, iterations=1, seed=0, device=CPU, targets=group.targets)
    learner.step(collect(group, learner.policy, 16, 4))
    held = learner.state_dict()["buffer"]
    del held["_rng"]
    assert needs(cfg, group.task)["algo.buffer_size"] == nbytes(held)


def test_a_buffer_that_cannot_fit_is_refused_before_anything_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "run"
    assert (
        main(["train", "algo=dqn", "algo.buffer_size=1000000000000", f"hydra.run.dir={folder}"])
        == 2
    )
    told = capsys.readouterr().err
    assert told.startswith("trackmdp train: algo.buffer_size=1000000000000: needs about 511,")
    assert told.endswith(" GiB are available\n")
    assert told.count("\n") == 1
    assert not folder.exists()


def test_a_batch_of_paths_that_cannot_fit_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert (
        main(
            [
                "train",
                "algo=hindsight",
                "algo.batch_size=999999999999",
                f"hydra.run.dir={tmp_path / 'run'}",
            ]
        )
        == 2
    )
    # 4 cells of a path with t_max 1, six numbers of 8 bytes for each: 192 bytes a path.
    assert "algo.batch_size=999999999999: needs about 178,813" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_batches_that_cannot_fit_are_named() -> None:
    cfg = train_config(
        "algo=ppo", "collector.frames_per_batch=2560000000", "collector.total_frames=2560000000"
    )
    with pytest.raises(
        UserError, match=r"^collector.frames_per_batch=2560000000: needs about [\d,.]+ GiB, "
    ):
        check_memory(cfg, small_world().task, CPU)


def test_targets_that_are_learned_together_and_cannot_fit_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["targets.count=1000", "collector.total_frames=2560000"]
    joint = [*words, "algo=a2c", "collector.frames_per_batch=2560000"]
    assert main(["train", *joint, f"hydra.run.dir={tmp_path / 'run'}"]) == 2
    told = capsys.readouterr().err
    assert told.startswith("trackmdp train: targets.count=1000: needs about 14,8")
    assert not (tmp_path / "run").exists()
    # A single target's plan takes what it takes, however many targets it is merged for.
    single, one = (train_config("algo=hindsight", *more) for more in (words[:1], []))
    task = small_world().task
    assert needs(single, task) == needs(one, task)


def test_a_run_says_what_it_takes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = [
        "grid.size=3",
        "collector.total_frames=512",
        "collector.frames_per_batch=512",
        "collector.envs=32",
    ]
    budget = ["algo=hindsight", "algo.updates=1", "optimal.enabled=false"]
    assert main(["train", *words, *budget, f"hydra.run.dir={tmp_path}"]) == 0
    (line,) = (line for line in capsys.readouterr().out.splitlines() if line.startswith("memory: "))
    assert re.fullmatch(r"memory: about 0\.00 GiB of [\d,.]+ GiB, most by [a-z_.]+", line)


@pytest.mark.parametrize(
    ("cgroup", "kib"),
    [
        ({}, 8000),
        ({"memory_max": "max\n", "memory_current": "1024\n"}, 8000),
        ({"memory_max": f"{5000 * 1024}\n", "memory_current": f"{2000 * 1024}\n"}, 3000),
        (
            {
                "memory_max": f"{5000 * 1024}\n",
                "memory_current": f"{2000 * 1024}\n",
                "memory_stat": f"anon 5\ninactive_file {500 * 1024}\n",
            },
            3500,
        ),
    ],
)
def test_the_job_may_have_less_than_the_machine(
    tmp_path: Path, cgroup: dict[str, str], kib: int
) -> None:
    assert free_bytes(system(tmp_path, 8000, **cgroup)) == kib * 1024


def test_a_system_that_does_not_say_counts_as_unlimited(tmp_path: Path) -> None:
    assert free_bytes(tmp_path) == 2**63


_FREED = """
import resource
import torch
from trackmdp.training.devices import reused_memory

def pages():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    torch.ones(2**24)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

with reused_memory():
    print(*[pages() for _ in range(10)])
"""
"""Prints how many pages of memory new tensors of 64 MB are given by the system."""


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "mallopt"), reason="glibc alone")
def test_a_freed_batch_is_used_again() -> None:
    """In a process of its own: its heap can grow, as nothing has been mapped behind it."""
    program = [sys.executable, "-c", _FREED]
    printed = subprocess.run(program, check=True, stdout=subprocess.PIPE, text=True).stdout
    # The first ones, with what is allocated beside them, make the room.
    assert int(printed.split()[-1]) < 100
