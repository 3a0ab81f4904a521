"""README and the handbook of commands: their set-up lines, figures, picture, Python and commands are true."""

from __future__ import annotations

import itertools
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

import trackmdp as tm
from tests.documents import ROOT, Block, blocks, commands, prose, words_of
from trackmdp.app.cli import main
from trackmdp.config import GROUPS

README = ROOT / "README.md"
COMMANDS_BOOK = ROOT / "scripts" / "README.md"
SHORT = {
    "train": [
        "collector.total_frames=8192",
        "collector.frames_per_batch=4096",
        "collector.envs=64",
        "optimal.nodes=100000",
    ],
    "evaluate": ["episodes=20"],
}
"""Words that make a command a matter of seconds."""
GLOSSARY = (
    "Task World Policy n Key AIHTR Regret T_max Safe_action c D r Z R Window Clocked Exchange"
)


def texts(path: Path, language: str) -> list[Block]:
    """The blocks of one language."""
    return [block for block in blocks(path) if block.language == language]


def test_two_lines_set_everything_up() -> None:
    lines = [line for line in commands(README) if line.startswith("pip install")]
    assert lines == [
        "pip install -e '.[dev]' && python scripts/train.py",
        "pip install -e '.[dev]' && pytest",
    ]


def test_the_readme_is_short() -> None:
    assert len(README.read_text(encoding="utf-8").split()) <= 1200


def test_every_word_of_the_glossary_has_one_line() -> None:
    section = prose(README).split("## Words")[1].split("\n## ")[0]
    words = re.findall(r"^- \*\*([\w ]+)\*\*.*: \w.*\.$", section, re.MULTILINE)
    assert [word.replace(" ", "_") for word in words] == GLOSSARY.split()


def test_the_picture_is_the_one_its_command_draws(empty_folder: Path) -> None:
    (line,) = (line for line in commands(COMMANDS_BOOK) if "baseline=clocked" in line)
    assert main([*(words_of(line) or []), "episodes=0", "quiet=true", "hydra.run.dir=."]) == 0
    drawn = (empty_folder / "picture.txt").read_text(encoding="utf-8").rstrip()
    assert [block.text for block in texts(COMMANDS_BOOK, "text")].count(drawn) == 1


def test_the_first_table_holds_the_exact_figures_of_its_world() -> None:
    (table,) = (block for block in texts(README, "text") if "AIHTR" in block.lines[0])
    shown = {line[:20].strip(): line[20:].split() for line in table.lines[1:]}
    world = tm.make_world("random_support", size=10, support_size=5, cost=0.16, t_max=1)
    references = {"Q_MDP": "qmdp", "all on": "all_on", "optimum": "optimal"}
    for row, name in references.items():
        found = tm.evaluate(world, name)
        figures = [f"{found.aihtr:,.3f}", f"{found.accuracy:.2%}"[:-1], "%"]
        assert shown[row] == [*figures, f"{found.sensors_per_step:.2f}"]
    assert shown["upper bound"] == [f"{tm.solve(world).upper:.3f}"]


def test_the_handbook_lists_all_baselines() -> None:
    named = re.search(r"^Baselines need no learning\.(.*?)\n\n", prose(COMMANDS_BOOK), re.M | re.S)
    assert named
    assert set(re.findall(r"`(\w+)`", named[1])) == set(GROUPS["baseline"])


@pytest.mark.slow
def test_the_lines_of_python_run(tmp_path: Path) -> None:
    """They print the learned value, close below the optimum, and write nothing."""
    (block,) = texts(README, "python")
    shown = blocks(README)[blocks(README).index(block) + 1]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-c", block.text],
        cwd=tmp_path, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    number = re.compile(r"\d+\.\d+")
    assert number.sub("#", done.stdout).splitlines() == [number.sub("#", x) for x in shown.lines]
    learned, optimum = map(float, number.findall(done.stdout))
    assert optimum - 0.5 < learned <= optimum
    assert list(tmp_path.iterdir()) == []


def plain(text: str) -> list[str]:
    """The lines of a table without its frame and spaces."""
    return [" ".join(re.sub(r"[^\w.,%-]", " ", line).split()) for line in text.splitlines()]


def tables_after(path: Path) -> dict[str, list[str]]:
    """First command of a block -> the lines of the table that is shown of its output."""
    every = blocks(path)
    return {
        block.lines[0]: plain(after.text)
        for block, after in itertools.pairwise(every)
        if (block.language, after.language) == ("sh", "text") and after.text.startswith("policy")
    }


def few(line: str) -> list[str]:
    """The words that make the paper's sweep one of a single pair and seed."""
    return (
        ["kernel.support_size=5", "kernel.seed=39", "cost.sensor=0.22", "seed=0"]
        if "experiment=paper" in line
        else []
    )


def as_typed(line: str) -> list[str] | None:
    """The process of a command line, made short; None where it installs packages or takes minutes."""
    if line.startswith("pip ") or "venv" in line or "benchmark" in line:
        return None
    words = words_of(line)
    if words is None:
        return [sys.executable, *shlex.split(line)[1:]]
    command, *more = words
    # Figures of several targets are exact, so that no episodes are simulated.
    short = [] if "targets.count" in line else SHORT.get(command, [])
    more += [*short, *few(line)]
    return [sys.executable, "-m", "trackmdp.app.cli", command, *more]


@pytest.mark.slow
def test_the_commands_run_in_this_order(tmp_path: Path) -> None:
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    # Whoever types the lines is in the checkout, and has its data.
    (tmp_path / "tests").symlink_to(ROOT / "tests")
    tables = tables_after(COMMANDS_BOOK)
    assert {line.split()[1] for line in tables} == {"solve", "frontier"}
    for line in dict.fromkeys([*commands(README), *commands(COMMANDS_BOOK)]):
        if (typed := as_typed(line)) is None:
            continue
        result = subprocess.run(
            typed, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
        )
        assert (result.returncode, result.stderr) == (0, ""), line
        assert set(tables.get(line, ())) <= set(plain(result.stdout)), line
    assert len(list(tmp_path.glob("multirun/a/*/summary.json"))) == 4
    assert len(list(tmp_path.glob("multirun/train-algo_a2c_ppo_*/*/summary.json"))) == 3
    for sweep in ("a", "paper"):
        assert (tmp_path / "multirun" / sweep / "report" / "report.html").is_file()
    assert (tmp_path / "runs/a/evaluation.json").is_file()


@pytest.mark.slow
def test_the_pictures_are_made_by_the_lines_of_the_sweep_and_its_report(tmp_path: Path) -> None:
    """A picture of other bytes, as another matplotlib draws it, has the same shapes and colours."""
    for begin in ("trackmdp train -m kernel.support_size", "trackmdp report sweep=multirun/a"):
        line = next(line for line in commands(COMMANDS_BOOK) if line.startswith(begin))
        subprocess.run(
            [sys.executable, "-m", "trackmdp.app.cli", *(words_of(line) or []), "quiet=true"],
            cwd=tmp_path,
            env=os.environ | {"PYTHONPATH": str(ROOT)},
            check=True,
        )
    made = (tmp_path / "multirun/a/report/figures/story.svg").read_text(encoding="utf-8")
    kept = (ROOT / ".pictures" / "story.svg").read_text(encoding="utf-8")
    assert re.findall(r"fill: #\w+", made) == re.findall(r"fill: #\w+", kept)
