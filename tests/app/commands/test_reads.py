"""An option that nothing reads is a bug: every recipe reads every one of its options."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.config.cases import composed
from tests.helpers import BASELINES, later
from tests.reads import record_reads, unread
from trackmdp.app.prepare import Prepared
from trackmdp.config import GROUPS, conf_dir
from trackmdp.config.credit import PerSensorConfig

SHORT = "quiet=true grid.size=3 collector.total_frames=2048 collector.frames_per_batch=1024 collector.envs=64"
DEFAULTS = {
    f"{file.parent.name}.{key}": source
    for file in Path(conf_dir()).glob("*/*.yaml")
    for key, source in re.findall(
        r"^(\w+): \$\{([\w.]+)\}", file.read_text(encoding="utf-8"), flags=re.MULTILINE
    )
}
"""Option -> the option it takes its value from, unless typed: reading the first reads the second."""


OF_BLOCKS = {"partition.halo", "partition.workers", "partition.cluster"}
"""Read where there are blocks alone, which `test_blocks` learns by."""
OF_SEVERAL = {"targets.merge", "evaluation.width"}
"""Read with several targets alone."""
MIXED = " algo=hindsight algo.updates=2 algo.collect=mixed collector.frames_per_batch=512 algo.explore.until=0.9"


def never_read(command: str, words: str, folder: Path) -> set[str]:
    cfg = composed(command, *words.split())
    with record_reads(cfg) as reads:
        Prepared(command, cfg, folder).run()
    return unread(cfg, reads | {source for key, source in DEFAULTS.items() if key in reads})


@pytest.mark.parametrize("algo", GROUPS["algo"])
def test_train_reads_every_option(algo: str, tmp_path: Path) -> None:
    words = f"algo={algo} {SHORT} optimal.nodes=100000"
    words += (
        MIXED
        if issubclass(GROUPS["algo"][algo], PerSensorConfig)
        else {
            "dqn": " algo.prioritized.enabled=true",
            "model_based": " algo.sensing=chosen algo.warm_up=1024 algo.estimate=paths",
        }.get(algo, "")
    )
    assert never_read("train", words, tmp_path) == OF_BLOCKS | OF_SEVERAL


def test_train_reads_the_options_of_several_targets(tmp_path: Path) -> None:
    words = f"algo=model_based {SHORT} optimal.nodes=100000 grid.t_max=0 targets.count=2"
    assert not never_read("train", words, tmp_path) & OF_SEVERAL


@pytest.mark.parametrize("collector", later(["multi_sync", "multi_async"]))
def test_collectors_with_workers_read_every_option(collector: str, tmp_path: Path) -> None:
    words = f"collector={collector} {SHORT}{MIXED}"
    assert never_read("train", words, tmp_path) == OF_BLOCKS | OF_SEVERAL


@pytest.mark.parametrize("baseline", BASELINES)
def test_evaluate_reads_every_option(baseline: str, tmp_path: Path) -> None:
    words = f"baseline={baseline} grid.size=3 quiet=true episodes=10"
    assert never_read("evaluate", words, tmp_path) == OF_SEVERAL


def test_evaluate_reads_the_options_of_several_targets(tmp_path: Path) -> None:
    words = "baseline=qmdp grid.size=3 grid.t_max=0 quiet=true targets.count=2"
    assert never_read("evaluate", words, tmp_path) == {"episodes"}


@pytest.mark.parametrize("solver", GROUPS["solver"])
def test_solve_reads_every_option(solver: str, tmp_path: Path) -> None:
    # with blocks, without which nothing of `partition` but its block is read
    assert not never_read(
        "solve", f"solver={solver} grid.size=3 quiet=true partition.block=2", tmp_path
    )


@pytest.mark.parametrize(
    "solver", ["optimal", *later(name for name in GROUPS["solver"] if name != "optimal")]
)
def test_frontier_reads_every_option(solver: str, tmp_path: Path) -> None:
    assert not never_read(
        "frontier", f"solver={solver} grid.size=3 quiet=true resolution=0.1", tmp_path
    )


def test_verify_reads_every_option(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("trackmdp.paper.proofs.of_searches", lambda: iter(()))  # reads no option
    assert not never_read("verify", "grid.size=3 quiet=true", tmp_path)
