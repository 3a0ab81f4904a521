"""`kernel=tracks`: what needs a motion model, and bad files, are refused in a line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.app.commands.test_tracks import CITY, folder
from tests.helpers import later
from tests.typed import refused
from trackmdp.config import GROUPS

__all__ = ["folder"]


NEEDS_THE_MODEL = sorted(
    set(GROUPS["baseline"]) - {"all_on", "none", "random_k", "sets", "playback", "optimal"}
)


def refused_baseline(name: str) -> tuple[str, str, str]:
    expected = "expected one of all_on, none, random_k, sets with kernel=tracks"
    return "evaluate", f"baseline={name}", f"baseline={name}: {expected}"


@pytest.mark.parametrize(
    ("command", "words", "message"),
    [
        ("solve", "", "kernel=tracks: expected a motion model"),
        ("verify", "", "kernel=tracks: expected a motion model"),
        (
            "train",
            "kernel.held_out=0.001",
            "kernel.held_out=0.001, kernel.validation=0.1: leave, of 60 tracks, none to judge on; expected at least",
        ),
        (
            "train",
            "kernel.validation=0.001",
            "kernel.held_out=0.2, kernel.validation=0.001: leave, of 60 tracks, none to choose by",
        ),
        (
            "train",
            "kernel.held_out=0.9",
            "kernel.held_out=0.9, kernel.validation=0.1: leave, of 60 tracks, none to learn from",
        ),
        ("train", "kernel.validation=1", "kernel.validation=1: expected a number > 0 and < 1"),
        ("train", "kernel.held_out=0", "kernel.held_out=0: expected a number > 0 and < 1"),
        ("train", "kernel.path=no.csv", "kernel.path="),
        (
            "train",
            f"kernel.path={CITY}",
            "kernel.step: missing, expected seconds from one cell to the next; kernel.path=",
        ),
        ("train", "kernel.step=5", "kernel.step=5: only for positions; kernel.path="),
        ("train", "grid.size=4 kernel.min_length=null", "kernel.path="),
        refused_baseline("optimal"),
        *later(refused_baseline(name) for name in NEEDS_THE_MODEL),
    ],
)
def test_what_cannot_be_is_refused(
    command: str, words: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    given = [
        "kernel=tracks",
        "kernel.path=../tracks.csv",
        "kernel.min_length=1",
        "grid.size=3",
        *words.split(),
    ]
    assert refused(capsys, command, *dict.fromkeys(given)).startswith(message)


BAD = {
    "gap": (
        "track,step,cell\n0,0,1\n0,1,1\n0,3,1\n0,4,1\n",
        "track 0: step 3 follows step 1, expected 2",
    ),
    "outside": ("track,cell\n0,1\n0,9\n0,1\n0,1\n", "cell of entry 2 is 9"),
    "twice": ("track,step,cell\n0,0,1\n0,1,1\n0,1,2\n0,2,1\n", "track 0: step 1 follows step 1"),
    "fraction": (
        "track,cell\n0,1\n0,0.5\n0,1\n0,1\n",
        "cell of entry 2 is 0.5, expected an integer",
    ),
    "short": (
        "track,cell\n0,1\n0,0\n0,1\n1,1\n1,1\n1,1\n1,1\n",
        "track 0 has 3 cells, expected at least 4",
    ),
    "empty": ("track,cell\n", "no tracks"),
    "nothing": ("", "columns"),
}


@pytest.mark.parametrize("case", BAD)
@pytest.mark.parametrize("command", ["train", *later(["evaluate"])])
def test_a_bad_file_is_refused_before_anything_is_written(
    command: str, case: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text, message = BAD[case]
    (tmp_path / "bad.csv").write_text(text)
    words = [
        "kernel=tracks",
        "kernel.path=../bad.csv",
        "grid.size=3",
        *(["baseline=none"] * (command == "evaluate")),
    ]
    line = refused(capsys, command, *words)
    place = f"kernel.path={tmp_path / 'here'}/../bad.csv"
    assert place in line
    assert case == "nothing" or line.startswith(f"{place}: {message}")


def test_a_pickled_file_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    objects: Any = np.array([{}], dtype=object)
    np.savez(tmp_path / "bad.npz", track=objects, cell=objects, allow_pickle=True)
    line = refused(capsys, "train", "kernel=tracks", "kernel.path=../bad.npz", "grid.size=3")
    assert "not a table of numbers" in line
