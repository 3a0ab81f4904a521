"""Configs and folders of the user's: data that name no code, composed and checked once."""

from __future__ import annotations

import importlib
import itertools
import os
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.helpers import later
from tests.typed import refused, stub, typed
from trackmdp.app.cli import main
from trackmdp.errors import RunError

pytestmark = pytest.mark.usefixtures("empty_folder")

EVIL = "{_target_: os.mkdir, path: mark}"


def test_a_config_folder_of_ones_own_adds_choices(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine/kernel").mkdir(parents=True)
    (tmp_path / "mine/kernel/slow.yaml").write_text("defaults: [random_walk]\nstay: 0.9\n")
    (tmp_path / "mine/kernel/typo.yaml").write_text("defaults: [random_walk]\nstai: 0.9\n")
    calls = []
    stub(monkeypatch, "train", lambda cfg, folder: calls.append(cfg))
    (tmp_path / "mine/experiment").mkdir()
    marked = tmp_path / "mine/experiment/marked.yaml"
    marked.write_text("# @package _global_\nseed: 7\n", "utf-8-sig")  # with a byte order mark
    words = ["train", "--config-dir", "../mine", "kernel=slow", "experiment=marked"]
    assert main([*words, "hydra.run.dir=../out"]) == 0
    assert (calls[0].kernel.name, calls[0].kernel.stay) == ("random_walk", 0.9)
    assert calls[0].seed == 7
    capsys.readouterr()
    said = refused(capsys, "train", "--config-dir", "../mine", "kernel=slow", "--help")
    assert said.endswith("; --cfg job shows a choice of --config-dir")
    assert "stai" in refused(capsys, "train", "--config-dir", "../mine", "kernel=typo")
    (tmp_path / "mine/algo").mkdir()
    (tmp_path / "mine/algo/bare.yaml").write_text("defaults: [base_ppo]\ngamma: 0.9\n")
    words = ["train", "--config-dir", "../mine", "algo=bare"]
    assert refused(capsys, *words) == "algo.total_frames: missing"
    budget = [f"algo.{name}=1" for name in ("total_frames", "frames_per_batch", "envs")]
    said = refused(capsys, *words, *budget)
    assert "algo.learning_rate: missing, expected its start, end, begin, until" in said


@pytest.mark.parametrize(
    ("file", "text", "words", "message"),
    [
        (
            "experiment/a",
            f"hydra: {{callbacks: {{x: {EVIL}}}}}",
            "experiment=a",
            "hydra.callbacks: not read",
        ),
        (
            "experiment/a",
            "hydra: {callbacks: {x: {path: mark}}}",
            "experiment=a",
            "hydra.callbacks: not read",
        ),
        (
            "experiment/a",
            "hydra: {job: {env_set: {PYTHONPATH: x}}}",
            "experiment=a",
            "hydra.job.env_set: not taken from a file",
        ),
        (
            "experiment/a",
            "seed: !!python/object/apply:os.mkdir [mark]",
            "experiment=a",
            "not a config",
        ),
        ("experiment/a", "seed: &a [*a]", "experiment=a", "not a config (an alias"),
        ("experiment/a", "seed: !!set {a}", "experiment=a", "experiment/a.yaml: not a config"),
        ("experiment/a", "# @package \nseed: 1", "experiment=a", "experiment/a.yaml: not a config"),
        (
            "experiment/a",
            f"seed: {'[' * 3000}{']' * 3000}",
            "experiment=a",
            "not a config",
        ),
        ("experiment/a", "- 1", "experiment=a", "expected a mapping"),
        ("experiment/a", "defaults: [a]", "experiment=a", "experiment=a: nested too deep, or a"),
        (
            "experiment/a",
            "hydra: {mode: MULTIRUN}",
            "experiment=a",
            "hydra.mode=MULTIRUN: expected -m",
        ),
        ("experiment/a", "x: " + "y" * 2**24, "experiment=a", "expected at most 16,777,216"),
        ("algo/a", f"defaults: [hindsight]\nx: {EVIL}", "algo=a", "'x' not in"),
        (
            "mine",
            "defaults: [base_train, _self_]\nhydra: {searchpath: ['pkg://email']}",
            "--config-name mine",
            "hydra.searchpath: expected --config-dir",
        ),
        (
            "hydra/job_logging/a",
            "root: {level: 1}\nfilters: {x: {(): os.mkdir}}",
            "hydra/job_logging=a",
            "hydra/job_logging: expected none",
        ),
        (
            "hydra/job_logging/a",
            "root: {level: INFO}",
            "hydra/job_logging=a",
            "hydra/job_logging: expected none",
        ),
        (
            "hydra/launcher/a",
            "defaults: [base_basic]\n_target_: os.mkdir",
            "-m seed=0,1 hydra/launcher=a",
            "'_target_' not in",
        ),
        (
            "sensor/a",
            "",
            "sensor=a",
            "sensor: expected a file that begins with defaults: [perfect|miss|",
        ),
        (
            "hydra/launcher/a",
            "x: 1",
            "-m seed=0,1 hydra/launcher=a",
            "hydra/launcher: expected one of basic, joblib",
        ),
    ],
)
def test_a_config_of_the_users_is_data(
    file: str,
    text: str,
    words: str,
    message: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = tmp_path / "mine" / f"{file}.yaml"
    path.parent.mkdir(parents=True)
    path.write_text(f"# @package _global_\n{text}\n" if "experiment" in file else f"{text}\n")
    assert message in refused(capsys, "train", "--config-dir", "../mine", *words.split())


def test_aliases_are_refused_before_they_unfold(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine/experiment").mkdir(parents=True)
    names = "abcdefghij"
    lines = ["a: &a [x,x,x,x,x,x,x,x,x]"]
    lines += [f"{c}: &{c} [{','.join([f'*{p}'] * 9)}]" for p, c in itertools.pairwise(names)]
    (tmp_path / "mine/experiment/a.yaml").write_text("\n".join(lines))
    assert "an alias" in refused(capsys, "train", "--config-dir", "../mine", "experiment=a")


@pytest.mark.filterwarnings("default")  # Python's own, which would be lines beside the one
def test_a_warning_that_a_config_asks_for_is_its_refusal(
    empty_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for words in (["seed=${oc.deprecated:threads}"], ["hydra.run.dir=r${oc.deprecated:seed}"]):
        assert "is deprecated" in refused(capsys, "train", *words)


def test_hydras_own_settings_still_hold(
    monkeypatch: pytest.MonkeyPatch, empty_folder: Path
) -> None:
    seen: list[Any] = []
    stub(
        monkeypatch,
        "train",
        lambda cfg, folder: seen.append((Path.cwd(), folder, os.environ.get("X_Y"))),
    )
    words = [
        "hydra.job.chdir=true",
        "hydra.output_subdir=.hydra",
        "+hydra.job.env_set.X_Y=1",
        "hydra.run.dir=r",
    ]
    assert main(["train", "quiet=true", "seed=${grid.size}", *words]) == 0
    assert seen == [(empty_folder / "r", empty_folder / "r", "1")]
    assert "X_Y" not in os.environ
    assert sorted(path.name for path in Path("r/.hydra").iterdir()) == [
        "config.yaml",
        "hydra.yaml",
        "overrides.yaml",
    ]


@pytest.mark.parametrize(
    "words", [["-c", "job", "-p", "grid"], ["--hydra-help"], *later([["--info", "searchpath"]])]
)
def test_questions_to_hydra_run_nothing(words: list[str], empty_folder: Path) -> None:
    result = typed("train", *words)
    assert (result.returncode, result.stderr) == (0, "")
    assert result.stdout
    assert not list(empty_folder.iterdir())


@pytest.mark.parametrize("words", [["seed=3"], ["kernel=table", "kernel.path=../k.npy"]])
def test_a_command_composes_once_checks_once_and_builds_one_world(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    np.save(tmp_path / "k.npy", np.full((100, 100), 0.009))
    counts = Counter[str]()

    def spy(module: str, name: str) -> None:
        owner = importlib.import_module(module)
        inner = getattr(owner, name)

        def counted(*args: Any, **kwargs: Any) -> Any:
            counts[name] += 1
            return inner(*args, **kwargs)

        monkeypatch.setattr(owner, name, counted)

    module = importlib.import_module("trackmdp.app.commands.train")
    spy("trackmdp.app.composer", "compose")
    spy("trackmdp.config.compose", "validate")
    spy("trackmdp.training.inputs", "make_problem")
    monkeypatch.setattr(
        module,
        "make_trainer",
        lambda problem, cfg, **_: (_ for _ in ()).throw(RunError("far enough")),
    )
    assert main(["train", *words]) == 1
    assert counts == {"compose": 1, "validate": 1, "make_problem": 1}
