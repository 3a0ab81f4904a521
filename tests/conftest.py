"""One thread, and the same hypothesis examples, on every machine; an empty folder to be in."""

from __future__ import annotations

import gc
import os
import signal
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
# Ray's workers run at the lowest priority but four: beside other tests that use all cores they would take minutes to
# start.
os.environ.setdefault("RAY_worker_niceness", "0")

import pytest
import torch
from hypothesis import settings

from trackmdp.solvers import hidden

torch.set_num_threads(1)
# A shell's job in the background ignores Ctrl-C, one behind `nohup` hangups, and so would all programs that a test
# starts from it.
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)
settings.register_profile("repeatable", deadline=None, derandomize=True, max_examples=30)
settings.load_profile("repeatable")


def pytest_collection_finish() -> None:
    """What is imported by now stays: without this each collection of garbage looks through all of it again."""
    gc.freeze()


@pytest.fixture
def little_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where modes are hidden, one start, two rounds and no crossing: for tests of what is made of a policy."""
    little = hidden.WHOLE._replace(led=1, annealed=0, crossed=0.0, rounds=2)
    for effort in ("WHOLE", "SHORT"):
        monkeypatch.setattr(hidden, effort, little)


@pytest.fixture
def empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder of a test, with nothing in it."""
    folder = tmp_path / "here"
    folder.mkdir()
    monkeypatch.chdir(folder)
    return folder
