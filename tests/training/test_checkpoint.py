"""Checkpoints are whole or absent, and nothing in a foreign one is ever run."""

from __future__ import annotations

import io
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from trackmdp.errors import UserError
from trackmdp.training import checkpoint

STATE = {"algorithm": {"weight": torch.arange(6.0).reshape(2, 3), "iteration": 3}, "frames": 4096}


def names(folder: Path) -> list[str]:
    return sorted(file.name for file in folder.glob("iteration-*"))


def test_what_is_saved_comes_back(tmp_path: Path) -> None:
    file = checkpoint.save(tmp_path / "checkpoints", 7, STATE, keep=2)
    assert file.name == "iteration-00000007.pt"
    assert checkpoint.newest(tmp_path) == file
    state = checkpoint.load(file)
    assert state["iteration"] == 7
    assert state["frames"] == 4096
    assert torch.equal(state["algorithm"]["weight"], STATE["algorithm"]["weight"])


def test_the_newest_are_kept_whatever_else_lies_there(tmp_path: Path) -> None:
    folder = tmp_path / "checkpoints"
    folder.mkdir()
    (folder / "iteration-note.pt").write_text("mine")
    for iteration in (1, 5, 9, 10, 100_000_000):
        checkpoint.save(folder, iteration, STATE, keep=3)
    kept = ["iteration-00000009.pt", "iteration-00000010.pt", "iteration-100000000.pt"]
    assert names(folder) == [*kept, "iteration-note.pt"]
    assert checkpoint.load(checkpoint.newest(tmp_path))["iteration"] == 100_000_000


@pytest.mark.parametrize("moment", ["save", "fsync", "replace"])
def test_a_crash_while_saving_leaves_the_last_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, moment: str) -> None:
    folder = tmp_path / "checkpoints"
    before = checkpoint.save(folder, 1, STATE, keep=1)
    content = before.read_bytes()

    def crash(*_: object) -> None:
        raise KeyboardInterrupt

    target = {"save": "torch.save", "fsync": "os.fsync", "replace": "pathlib.Path.replace"}[moment]
    monkeypatch.setattr(target, crash)
    with pytest.raises(KeyboardInterrupt):
        checkpoint.save(folder, 2, STATE, keep=1)
    monkeypatch.undo()
    assert names(folder) == [before.name]
    assert checkpoint.newest(tmp_path).read_bytes() == content
    checkpoint.save(folder, 2, STATE, keep=1)
    assert names(folder) == ["iteration-00000002.pt"]


def test_a_run_without_a_checkpoint_says_so(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="the run has not saved one yet"):
        checkpoint.newest(tmp_path)


class Trap:
    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[Any, ...]:
        return (Path.touch, (self.mark,))


def pickled(file: Path) -> bytes:
    return pickle.dumps(Trap(file.with_name("executed")))


def trapped(file: Path) -> bytes:
    stream = io.BytesIO()
    torch.save({"format": checkpoint.FORMAT, "x": Trap(file.with_name("executed"))}, stream)
    return stream.getvalue()


def trapped_inside(file: Path) -> bytes:
    """A genuine checkpoint, header and all, whose content runs code when it is unpickled."""
    made = checkpoint.save(file.parent / "other", 1, {"x": Trap(file.with_name("executed"))}, keep=1)
    return made.read_bytes()


def other_format(file: Path) -> bytes:
    stream = io.BytesIO()
    torch.save({"format": checkpoint.FORMAT + 1}, stream)
    return stream.getvalue()


def tensor(file: Path) -> bytes:
    stream = io.BytesIO()
    torch.save(torch.ones(3), stream)
    return stream.getvalue()


def zipped(file: Path) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr("hello", "world")
    return stream.getvalue()


def flipped(file: Path) -> bytes:
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    return bytes(content)


FOREIGN: dict[str, Callable[[Path], bytes]] = {
    "empty": lambda file: b"",
    "text": lambda file: b"hello\nworld\n",
    "half": lambda file: file.read_bytes()[: len(file.read_bytes()) // 2],
    "short by a byte": lambda file: file.read_bytes()[:-1],
    "a bit flipped": flipped,
    "zip": zipped,
    "a tensor": tensor,
    "another format": other_format,
    "pickle": pickled,
    "trap": trapped,
    "trap with a header": trapped_inside,
}


@pytest.mark.parametrize("case", FOREIGN)
def test_a_damaged_or_foreign_file_is_refused_in_one_line_and_runs_nothing(tmp_path: Path, case: str) -> None:
    file = checkpoint.save(tmp_path / "checkpoints", 1, STATE, keep=1)
    file.write_bytes(FOREIGN[case](file))
    with pytest.raises(UserError) as refused:
        checkpoint.load(file)
    assert str(file) in str(refused.value)
    assert "\n" not in str(refused.value)
    assert not list(tmp_path.rglob("executed"))
