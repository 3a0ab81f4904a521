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
    ],
)
def test_a_line_is_completed(
    script: str, line: str, offered: set[str], hidden: set[str], tmp_path: Path
) -> None:
    (tmp_path / "trackmdp").write_text(f'#!/bin/sh\nexec {sys.executable} -m trackmdp "$@"\n')
    (tmp_path / "trackmdp").chmod(0o755)
    words = [*line.split(), ""] if line.endswith(" ") else line.split()
    ask = (
        f"{script}\nPATH={tmp_path}:$PATH\nCOMP_LINE='{line}'\nCOMP_WORDS=({' '.join(map(repr, words))})\n"
        f"COMP_CWORD={len(words) - 1}\n_trackmdp\nprintf '%s\\n' \"${{COMPREPLY[@]}}\"\n"
    )
    done = subprocess.run(
        ["bash", "-c", ask], capture_output=True, text=True, env=ENVIRONMENT, check=True
    )
    found = set(done.stdout.splitlines())
    assert offered <= found
    assert not hidden & found
