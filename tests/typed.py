"""Commands as a user types them, run in this process or in one of their own, in an empty folder."""

from __future__ import annotations

import os
import subprocess
import sys
import types
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from trackmdp.app.cli import main

ROOT = Path(__file__).parents[1]
ENVIRONMENT = os.environ | {"PYTHONPATH": str(ROOT)}


def stub(monkeypatch: pytest.MonkeyPatch, command: str, run: Callable[[Any, Path], Any]) -> None:
    """Let `run` do the work of a command."""
    module = types.ModuleType(f"trackmdp.app.commands.{command}")
    module.run = lambda cfg, folder, problem=None: run(cfg, folder)  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, module.__name__, module)


def refused(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """The one line with which a command refuses `words`; nothing may have been written to the current folder."""
    status = main(list(words))
    captured = capsys.readouterr()
    lines = captured.err.splitlines()
    assert (status, len(lines), captured.out) == (2, 1, ""), (words, status, captured)
    assert not list(Path.cwd().iterdir()), words
    prefix = f"trackmdp {words[0]}: "
    assert lines[0].startswith(prefix)
    return lines[0].removeprefix(prefix)


def typed(
    *words: str, start: Sequence[str] = ("-m", "trackmdp.app.cli"), **kwargs: Any
) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *start, *words],
        capture_output=True,
        text=True,
        env=ENVIRONMENT,
        check=False,
        **kwargs,
    )
