"""No process that a command starts imports modules from the current folder."""

from __future__ import annotations

import importlib.util
import subprocess
from pathlib import Path
from typing import Any

import pytest

from tests.typed import ROOT, typed
from trackmdp.imports import safe_children


def installed(package: str) -> pytest.MarkDecorator:
    absent = importlib.util.find_spec(package) is None
    return pytest.mark.skipif(absent, reason=f"{package} is not installed")


SOLVE = "solve -m grid.size=3 hydra/launcher="
BLOCKS = "solve grid.size=6 partition.block=3 partition.workers=2 cost.safe=16"
TRAIN = (
    "train algo=ppo grid.size=3 collector.total_frames=256 collector.frames_per_batch=256 "
    "collector.envs=32 algo.minibatches=1 optimal.enabled=false collector="
)
LINES = [
    f"{SOLVE}basic",
    pytest.param(f"{SOLVE}joblib", marks=[installed("joblib"), pytest.mark.slow]),
    pytest.param(f"{SOLVE}submitit_local", marks=[installed("submitit"), pytest.mark.slow]),
    BLOCKS,
    pytest.param(f"{TRAIN}multi_sync", marks=pytest.mark.slow),
    pytest.param(f"{TRAIN}multi_async", marks=pytest.mark.long),
    pytest.param(f"{SOLVE}ray", marks=[installed("ray"), pytest.mark.slow]),
    pytest.param(f"{BLOCKS} partition.cluster=local", marks=[installed("ray"), pytest.mark.long]),
    pytest.param(f"{TRAIN}ray", marks=[installed("ray"), pytest.mark.long]),
]


@pytest.mark.parametrize("line", LINES)
def test_modules_in_the_current_folder_run_in_no_child(line: str, tmp_path: Path) -> None:
    import_leaves_a_mark = "open(__name__ + '.ran', 'w').close()\nraise ImportError\n"
    for name in ("random", "types", "queue", "scipy"):
        (tmp_path / f"{name}.py").write_text(import_leaves_a_mark)
    command, *words = line.split()
    done = typed(*words, start=[str(ROOT / "scripts" / f"{command}.py")], cwd=tmp_path)
    assert (done.returncode, list(tmp_path.glob("*.ran"))) == (0, []), done.stderr


def test_a_program_run_as_a_module_leaves_the_current_folder(tmp_path: Path) -> None:
    (tmp_path / "joblib.py").write_text("open('joblib.ran', 'w').close()\n")
    typed("solve", "-m", "grid.size=3", "hydra/launcher=joblib", cwd=tmp_path)
    assert not (tmp_path / "joblib.ran").exists()


@pytest.mark.parametrize("before", [None, "0"])
def test_the_environment_is_put_back(before: str | None, monkeypatch: pytest.MonkeyPatch) -> None:
    def value() -> Any:
        words = ["sh", "-c", "echo ${PYTHONSAFEPATH-none}"]
        return subprocess.run(words, capture_output=True, text=True, check=True).stdout.strip()

    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
    if before is not None:
        monkeypatch.setenv("PYTHONSAFEPATH", before)
    with safe_children():
        assert value() == "1"
    assert value() == (before or "none")
