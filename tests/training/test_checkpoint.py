"""Checkpoints are whole or absent, and what is not exactly what was written is not taken."""

from __future__ import annotations

import errno
import hashlib
import io
import os
import pickle
import random
import re
import resource
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.helpers import later
from tests.training.runs import train
from trackmdp import durable
from trackmdp.errors import UserError
from trackmdp.training import checkpoint
from trackmdp.training.folders import SUMMARY
from trackmdp.training.run import load_run, trained


def state(seed: int = 0, size: int = 2000) -> dict[str, Any]:
    rng = torch.Generator().manual_seed(seed)
    weights = torch.rand(size, generator=rng)
    return {
        "weights": weights,
        "counter": seed,
        "nested": {"flags": weights > 0.5, "rates": [0.1, None, "a"]},
    }


@contextmanager
def disk_of(bytes_per_file: int) -> Iterator[None]:
    """No file may grow beyond this: a write fails as it does on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (bytes_per_file, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def names(folder: Path) -> list[str]:
    return sorted(file.name for file in folder.iterdir())


def sealed(payload: bytes) -> bytes:
    """A file that passes every check on its bytes."""
    return payload + checkpoint._seal(hashlib.sha256(payload).hexdigest())


def corrupted(content: bytes, other: bytes, rng: random.Random) -> bytes:
    """One of: a few bits flipped, cut, something appended, the content of another file."""
    kind = rng.choice(["flip", "cut", "append", "swap"])
    if kind == "flip":
        changed = bytearray(content)
        for place in rng.sample(range(len(content)), rng.randint(1, 3)):
            changed[place] ^= 1 << rng.randrange(8)
        return bytes(changed)
    if kind == "cut":
        return content[: rng.randrange(len(content))]
    if kind == "append":
        return content + rng.choice([b"\n", b"\0" * 4096, content[: rng.randint(1, 999)], content])
    seal = len(checkpoint._seal("0" * 64))
    return other[:-seal] + content[-seal:]


def test_what_is_read_is_what_was_saved(tmp_path: Path) -> None:
    file = checkpoint.save(tmp_path / "checkpoints", 7, state(3), keep=2)
    read = checkpoint.load(file)
    assert (read["iteration"], read["counter"], read["nested"]["rates"]) == (7, 3, [0.1, None, "a"])
    assert torch.equal(read["weights"], state(3)["weights"])
    assert torch.equal(read["nested"]["flags"], state(3)["nested"]["flags"])


def test_a_large_tensor_is_a_page_of_the_file_and_writing_to_it_leaves_the_file_alone(
    tmp_path: Path,
) -> None:
    file = checkpoint.save(tmp_path / "checkpoints", 1, state(size=2**19), keep=2)
    read = checkpoint.load(file)
    read["weights"].zero_()
    assert torch.equal(checkpoint.load(file)["weights"], state(size=2**19)["weights"])


def test_the_newest_are_kept_and_the_best_for_ever(tmp_path: Path) -> None:
    for iteration in range(1, 6):
        checkpoint.save(tmp_path, iteration, state(iteration), keep=2, best=iteration == 2)
    assert names(tmp_path) == [
        "best.pt",
        "iteration-00000004.pt",
        "iteration-00000005.pt",
        "last.pt",
    ]
    assert [
        checkpoint.load(tmp_path / name)["iteration"] for name in (checkpoint.BEST, checkpoint.LAST)
    ] == [2, 5]
    assert [file.name for file in checkpoint.available_checkpoints(tmp_path)] == [
        "iteration-00000005.pt",
        "iteration-00000004.pt",
    ]


def test_two_hundred_random_corruptions_are_all_refused(tmp_path: Path) -> None:
    file = checkpoint.save(tmp_path / "mine", 1, state(1), keep=1)
    other = checkpoint.save(tmp_path / "theirs", 1, state(2), keep=1).read_bytes()
    content, rng = file.read_bytes(), random.Random(7)
    for trial in range(200):
        file.write_bytes(changed := corrupted(content, other, rng))
        assert changed != content
        with pytest.raises(UserError, match=re.escape(str(file))):
            checkpoint.load(file)
            pytest.fail(f"corruption {trial} was loaded")
    file.write_bytes(content)
    assert checkpoint.load(file)["counter"] == 1


class Doctored:
    """Pickled, it is a call of `os.mkdir`."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> Any:
        return os.mkdir, (str(self.marker),)


def test_code_in_a_checkpoint_is_not_run(tmp_path: Path) -> None:
    file, marker = tmp_path / "iteration-00000001.pt", tmp_path / "executed"
    zipped = io.BytesIO()
    torch.save({"evil": Doctored(marker)}, zipped)
    for payload in (zipped.getvalue(), pickle.dumps(Doctored(marker)), b"", b"\x80\x02."):
        file.write_bytes(sealed(payload))
        with pytest.raises(UserError, match="not a checkpoint that can be read"):
            checkpoint.load(file)
        assert not marker.exists()
    pickle.loads(pickle.dumps(Doctored(marker)))  # noqa: S301  it does run when it is unpickled
    assert marker.exists()


def test_a_file_without_a_seal_is_refused(tmp_path: Path) -> None:
    torch.save({"iteration": 3}, tmp_path / "foreign.pt")
    with pytest.raises(UserError, match="not a checkpoint of this program"):
        checkpoint.load(tmp_path / "foreign.pt")


def test_an_older_format_is_named(tmp_path: Path) -> None:
    file = checkpoint.save(tmp_path, 1, state(), keep=1)
    file.write_bytes(
        file.read_bytes().replace(
            f"checkpoint {checkpoint.CHECKPOINT_FORMAT} ".encode(), b"checkpoint 1 "
        )
    )
    with pytest.raises(UserError, match=f"format 1, expected {checkpoint.CHECKPOINT_FORMAT}"):
        checkpoint.load(file)


@pytest.mark.parametrize("room", [0, 300, 5000, 8000])
def test_a_full_disk_leaves_the_older_checkpoints_whole(tmp_path: Path, room: int) -> None:
    checkpoint.save(tmp_path, 1, state(1), keep=1, best=True)
    before = names(tmp_path)
    with disk_of(room), pytest.raises(OSError, match="too large"):
        checkpoint.save(tmp_path, 2, state(2), keep=1, best=True)
    assert names(tmp_path) == before
    assert checkpoint.load(checkpoint.available_checkpoints(tmp_path)[0])["counter"] == 1
    checkpoint.save(tmp_path, 2, state(2), keep=1, best=True)
    assert checkpoint.load(tmp_path / checkpoint.LAST)["counter"] == 2


def test_the_reason_of_a_failed_write_is_not_lost_in_torch(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Full(io.BufferedRandom):
        def write(self, piece: Any) -> int:
            if self.tell() > 500:
                raise OSError(28, "No space left on device")
            return super().write(piece)

    monkeypatch.setattr(durable, "create", lambda file: Full(io.FileIO(file, "x+")))
    with pytest.raises(OSError, match="No space left"):
        checkpoint.save(tmp_path, 1, state(), keep=1)


@pytest.mark.parametrize("call", ["fsync", "link"])
def test_a_failure_at_any_step_leaves_a_whole_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: str
) -> None:
    def fails(*args: Any) -> None:
        raise OSError(28, "No space left on device")

    checkpoint.save(tmp_path, 1, state(1), keep=2)
    with monkeypatch.context() as patch:
        patch.setattr(os, call, fails)
        with pytest.raises(OSError, match="No space"):
            checkpoint.save(tmp_path, 2, state(2), keep=2)
    assert not [name for name in names(tmp_path) if name.endswith(".part")]
    newest = checkpoint.load(checkpoint.available_checkpoints(tmp_path)[0])
    assert newest["counter"] == newest["iteration"]


def test_saving_does_not_hold_the_state_twice(tmp_path: Path) -> None:
    large = {"buffer": torch.ones(2**24)}
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (size + large["buffer"].nbytes // 2, hard))
    try:
        file = checkpoint.save(tmp_path, 1, large, keep=1)
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
    assert torch.equal(checkpoint.load(file)["buffer"], large["buffer"])


def test_what_a_killed_save_left_is_cleared_away(tmp_path: Path) -> None:
    (tmp_path / ".iteration-00000009.pt.01ab.part").write_bytes(b"half")
    checkpoint.save(tmp_path, 10, state(), keep=2)
    assert names(tmp_path) == ["iteration-00000010.pt", "last.pt"]


def archived(content: bytes, method: int) -> bytes:
    """The members of a checkpoint's archive, packed anew, and a gigabyte of zeros where they are compressed."""
    packed = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as old, zipfile.ZipFile(packed, "w", method) as new:
        for member in old.infolist():
            new.writestr(member, old.read(member), method)
        if method == zipfile.ZIP_DEFLATED:
            with new.open("archive/data/bomb", "w", force_zip64=True) as stream:
                for _ in range(64):
                    stream.write(bytes(2**20))
    return packed.getvalue()


@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_an_archive_that_unfolds_is_refused(tmp_path: Path, method: int) -> None:
    file = checkpoint.save(tmp_path, 1, state(), keep=1)
    file.write_bytes(sealed(archived(file.read_bytes()[:-128], method)))
    if method == zipfile.ZIP_STORED:
        assert checkpoint.load(file)["counter"] == 0
        return
    with pytest.raises(UserError, match="a compressed archive"):
        checkpoint.load(file)


def test_what_is_no_ordinary_file_is_neither_read_nor_removed(tmp_path: Path) -> None:
    mine = checkpoint.save(tmp_path, 1, state(1), keep=1)
    (tmp_path / "iteration-00000007.pt").mkdir()
    os.mkfifo(tmp_path / "iteration-00000008.pt")
    (tmp_path / "iteration-00000009.pt").symlink_to(mine)
    assert checkpoint.available_checkpoints(tmp_path) == [mine]
    newer = checkpoint.save(tmp_path, 2, state(2), keep=1)
    assert checkpoint.available_checkpoints(tmp_path) == [newer]
    for number, kind in ((7, "is a directory"), (8, "a pipe"), (9, "a symbolic link")):
        with pytest.raises(UserError, match=f"iteration-0000000{number}.pt: {kind}"):
            checkpoint.load(tmp_path / f"iteration-0000000{number}.pt")


def test_a_folder_of_checkpoints_that_is_a_link_is_refused(tmp_path: Path) -> None:
    (tmp_path / "theirs").mkdir()
    (tmp_path / "theirs/notes.part").write_text("mine")
    (tmp_path / "checkpoints").symlink_to(tmp_path / "theirs")
    with pytest.raises(UserError, match="a link or a file, expected a folder of the run's own"):
        checkpoint.save(tmp_path / "checkpoints", 1, state(), keep=1)
    assert names(tmp_path / "theirs") == ["notes.part"]


def test_without_hard_links_the_names_are_copies(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*args: Any) -> None:
        raise PermissionError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "link", refused)
    for iteration in (1, 2, 3):
        checkpoint.save(tmp_path, iteration, state(iteration), keep=1, best=iteration == 2)
    assert names(tmp_path) == ["best.pt", "iteration-00000003.pt", "last.pt"]
    assert [
        checkpoint.load(tmp_path / name)["counter"] for name in (checkpoint.BEST, checkpoint.LAST)
    ] == [2, 3]


def test_a_run_killed_between_two_names_gets_them_when_it_resumes(tmp_path: Path) -> None:
    checkpoint.save(tmp_path, 1, state(1), keep=2, best=True)
    file = checkpoint.save(tmp_path, 2, state(2), keep=2)
    checkpoint.point(file, best=True)
    assert [
        checkpoint.load(tmp_path / name)["counter"] for name in (checkpoint.BEST, checkpoint.LAST)
    ] == [2, 2]


def test_what_a_kill_between_two_names_left_is_cleared_away(tmp_path: Path) -> None:
    file = checkpoint.save(tmp_path, 1, state(), keep=2)
    (tmp_path / ".last.pt.0123abcd.part").hardlink_to(file)
    checkpoint.point(file, best=False)
    assert names(tmp_path) == ["iteration-00000001.pt", "last.pt"]


def test_a_name_given_twice_leaves_nothing_behind(tmp_path: Path) -> None:
    file = checkpoint.save(tmp_path, 1, state(1), keep=2, best=True)
    checkpoint.point(file, best=True)
    assert names(tmp_path) == ["best.pt", "iteration-00000001.pt", "last.pt"]


@pytest.mark.parametrize("algo", ["dqn", *later(["hindsight"])])
def test_a_run_of_another_kind_of_device_is_looked_at_here_and_not_resumed(
    algo: str, tmp_path: Path
) -> None:
    """A generator's state has 16 bytes on a GPU, 5,056 on a CPU."""
    train(tmp_path, algo=algo)
    file = checkpoint.newest(tmp_path)
    saved = checkpoint.load(file)
    saved["algorithm"]["generator"] = torch.zeros(16, dtype=torch.uint8)
    saved["versions"]["device"] = "cuda"
    checkpoint.save(file.parent, saved.pop("iteration"), saved, keep=1)
    policy = trained(str(tmp_path), torch.device("cpu"))[1]
    assert (policy.sets != load_run(tmp_path).policy.sets).nnz == 0
    (tmp_path / SUMMARY).unlink()
    with pytest.raises(UserError, match="written with device cuda, this is cpu; expected the same"):
        train(tmp_path, "resume=auto", "checkpoint.keep=1", algo=algo)
