"""A sweep that tests read, and a copy that a test may change."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tests.reports.sweeps import write_sweep


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_sweep(tmp_path_factory.mktemp("sweep"))


@pytest.fixture
def sweep(whole: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(whole, tmp_path / "sweep"))
