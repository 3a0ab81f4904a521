"""The wheel is complete: it carries conf/ and the command, and needs nothing of the clone."""

from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The bin folder of a new environment with the wheel in it, and the packages of this one beside it."""
    folder = tmp_path_factory.mktemp("wheel")
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", folder],
        cwd=ROOT,
        check=True,
    )
    (wheel,) = folder.glob("*.whl")
    venv.create(folder / "venv", with_pip=True)
    python = folder / "venv/bin/python"
    pip = [
        python,
        "-m",
        "pip",
        "install",
        "--quiet",
        "--no-index",
        "--no-deps",
        "--disable-pip-version-check",
    ]
    subprocess.run([*pip, wheel], check=True)
    (packages,) = (folder / "venv/lib").glob("python*/site-packages")
    (packages / "others.pth").write_text(sysconfig.get_path("purelib"))
    return python.parent


def run(installed: Path, folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    clean = {
        key: value
        for key, value in os.environ.items()
        if not key.startswith(("PYTHON", "TRACKMDP"))
    }
    return subprocess.run(
        [installed / "trackmdp", *words],
        cwd=folder,
        env=clean,
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.slow
def test_the_wheel_brings_its_command_and_its_options(installed: Path, tmp_path: Path) -> None:
    helped = run(installed, tmp_path, "train", "--help", "all")
    assert (helped.returncode, helped.stderr) == (0, "")
    assert " kernel.support_size=5 " in helped.stdout
    where = run(installed, tmp_path, "train", "--info", "searchpath")
    assert f"file://{installed.parent}" in where.stdout
    assert str(ROOT) not in where.stdout
    assert list(
        installed.parent.glob("lib/python*/site-packages/trackmdp/py.typed")
    )  # its types are to be used


@pytest.mark.slow
def test_the_wheel_evaluates_from_any_folder(installed: Path, tmp_path: Path) -> None:
    result = run(
        installed,
        tmp_path,
        "evaluate",
        "baseline=qmdp",
        "grid.size=3",
        "episodes=0",
        "hydra.run.dir=out",
    )
    assert (result.returncode, result.stderr) == (0, "")
    assert (tmp_path / "out/evaluation.json").is_file()
