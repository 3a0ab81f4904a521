"""Completion in bash, as the script that a user evaluates gives it."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.typed import ENVIRONMENT
from trackmdp.app.cli import COMMANDS, main

if shutil.which("bash") is None:
    pytest.skip("needs bash", allow_module_level=True)


@pytest.fixture
def script(capsys: pytest.CaptureFixture[str]) -> str:
    assert main(["train", "-sc", "install=bash"]) == 0
    return capsys.readouterr().out


@pytest.mark.usefixtures("empty_folder")
@pytest.mark.parametrize(
    ("line", "offered", "hidden"),
    [
        ("trackmdp tr", {"train "}, set()),
        ("trackmdp ", {f"{name} " for name in COMMANDS}, set()),
        ("trackmdp train algo=", {"algo=ppo", "algo=hindsight"}, {"algo=base_ppo"}),
        ("trackmdp train algo=pp", {"algo=ppo", "algo=ppo_per_sensor"}, {"algo=dqn"}),
        ("trackmdp train kernel=", {"kernel=drift", "kernel=tracks"}, {"kernel=given"}),
        ("trackmdp evaluate grid.t", {"grid.t_max="}, {"grid.size="}),
        ("trackmdp compare run", {"runs="}, {"runs."}),
    ],
)
def test_a_line_is_completed(
    script: str, line: str, offered: set[str], hidden: set[str], tmp_path: Path
) -> None:
    found = completed(script, line, tmp_path)
    assert offered <= found
    assert not hidden & found


@pytest.mark.usefixtures("empty_folder")
def test_the_name_of_a_file_is_no_command(script: str, tmp_path: Path) -> None:
    """It is neither run where the line is completed, nor where the completed line is typed."""
    for name in ("$(>ran)", "`>ran`", "a;>ran", "b.csv"):
        Path(name).touch()
    found = completed(script, "trackmdp replay file=./", tmp_path)
    assert not Path("ran").exists()
    assert "file=./b.csv" in found
    for each in found:
        typed = subprocess.run(
            ["bash", "-c", f"printf %s {each}"], capture_output=True, text=True, check=True
        )
        assert Path(typed.stdout.removeprefix("file=")).exists()
    assert not Path("ran").exists()


def completed(script: str, line: str, folder: Path) -> set[str]:
    """What bash offers at the end of `line`; a command `trackmdp` is put into `folder`."""
    (folder / "trackmdp").write_text(f'#!/bin/sh\nexec {sys.executable} -m trackmdp "$@"\n')
    (folder / "trackmdp").chmod(0o755)
    words = [*line.split(), ""] if line.endswith(" ") else line.split()
    ask = (
        f"{script}\nPATH={folder}:$PATH\nCOMP_LINE='{line}'\nCOMP_WORDS=({' '.join(map(repr, words))})\n"
        f"COMP_CWORD={len(words) - 1}\n_trackmdp\nprintf '%s\\n' \"${{COMPREPLY[@]}}\"\n"
    )
    done = subprocess.run(
        ["bash", "-c", ask], capture_output=True, text=True, env=ENVIRONMENT, check=True
    )
    return set(done.stdout.splitlines())
