"""A run that several files of tests go on from."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.training.runs import train


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run with three checkpoints."""
    folder = tmp_path_factory.mktemp("state") / "whole"
    train(folder, "checkpoint.keep=3")
    return folder
