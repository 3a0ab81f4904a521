"""What the README says is so: its picture, its files, its commands."""

from __future__ import annotations

import itertools
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from trackmdp.app.cli import main
from trackmdp.config import GROUPS

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCKS = [line[4:] for line in TEXT.splitlines() if line.startswith("    ")]
SETUP = [line for line in BLOCKS if line.startswith("pip install")]
COMMANDS = [line for line in BLOCKS if line.startswith(("python ", "trackmdp "))]
OURS = [line for line in COMMANDS if not line.startswith(("python -c", "python -m venv"))]
SHORT = {
    "train": [
        "collector.total_frames=8192",
        "collector.frames_per_batch=4096",
        "collector.envs=64",
        "optimal.nodes=100000",
    ],
    "evaluate": ["episodes=20"],
}


def words_of(line: str) -> list[str]:
    """A line of the README as the words after `trackmdp`."""
    words = shlex.split(line)
    if words[0] == "trackmdp":
        return words[1:]
    script = re.fullmatch(r"scripts/(\w+)\.py", words[1])
    assert script, line
    assert (ROOT / words[1]).is_file()
    return [script[1], *words[2:]]


def test_two_lines_set_everything_up() -> None:
    assert SETUP == [
        "pip install -e '.[dev]' && python scripts/train.py",
        "pip install -e '.[dev]' && pytest",
    ]
    assert SETUP[1] == next(line for line in BLOCKS if line.endswith("pytest"))


@pytest.mark.parametrize("line", OURS)
def test_every_command_is_one_that_the_options_allow(
    line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    command, *words = words_of(line)
    words = [word for word in words if word != "-m" and "," not in word and not word.startswith("hydra")]
    assert main([command, *words, "-c", "job"]) == 0, capsys.readouterr().err


def test_the_picture_is_the_one_its_command_draws(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (line,) = (line for line in OURS if "baseline=clocked" in line)
    assert main([*words_of(line), "episodes=0", "quiet=true", "hydra.run.dir=."]) == 0
    drawn = (tmp_path / "picture.txt").read_text(encoding="utf-8").rstrip()
    assert "\n".join(line[4:] for line in TEXT.splitlines()).count(drawn) == 1


def test_named_files_and_choices_exist() -> None:
    for path in set(re.findall(r"`((?:trackmdp|conf|scripts)/[\w/.]+)`", TEXT)):
        assert (ROOT / path).exists() or "mine" in path, path
    named = re.search(r"evaluated in the same way: (.*?)\.\n", TEXT, flags=re.DOTALL)
    assert named
    assert set(re.findall(r"`(\w+)`", named[1])) == set(GROUPS["baseline"])


def few(line: str) -> list[str]:
    """What makes the paper's sweep one of a single pair and seed."""
    return (
        ["kernel.support_size=5", "kernel.seed=39", "cost.sensor=0.22", "seed=0"] if "experiment=paper" in line else []
    )


@pytest.mark.slow
def test_the_lines_of_python_run(tmp_path: Path) -> None:
    """What they print: the learned value, close below the bound."""
    start = BLOCKS.index("import trackmdp as tm")
    block = itertools.takewhile(lambda line: "tm" in line, BLOCKS[start:])
    words = [sys.executable, "-c", "\n".join([*block, "print(len(episodes), env.batch_size)"])]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(words, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    figures, sizes = done.stdout.splitlines()
    learned, upper = map(float, figures.split())
    assert upper - 0.5 < learned < upper
    assert sizes == "100 torch.Size([64])"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_the_commands_run_in_this_order(tmp_path: Path) -> None:
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    (tmp_path / "tests").symlink_to(ROOT / "tests")  # whoever types the lines is in the checkout, and has its data
    for line in COMMANDS:
        if "venv" in line or "benchmark" in line:  # the peers' packages, gigabytes of them, and their minutes
            continue
        if line in OURS:
            command, *words = words_of(line)
            typed = [sys.executable, "-m", "trackmdp.app.cli", command, *words, *SHORT.get(command, []), *few(line)]
        else:
            typed = [sys.executable, *shlex.split(line)[1:]]
        result = subprocess.run(typed, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
        assert (result.returncode, result.stderr) == (0, ""), line
    assert len(list(tmp_path.glob("multirun/a/*/summary.json"))) == 4
    assert len(list(tmp_path.glob("multirun/train-algo_a2c_ppo-*/*/summary.json"))) == 4
    for sweep in ("a", "paper"):
        assert (tmp_path / "multirun" / sweep / "report" / "report.html").is_file()
    assert (tmp_path / "runs/a/evaluation.json").is_file()
