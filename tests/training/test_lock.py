"""One process per folder."""

from __future__ import annotations

import errno
import fcntl
import re
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from trackmdp import durable
from trackmdp.errors import UserError
from trackmdp.training.lock import is_locked, locked


def test_a_folder_is_held_once(tmp_path: Path) -> None:
    assert not is_locked(tmp_path)
    with locked(tmp_path):
        assert is_locked(tmp_path)
        with (
            pytest.raises(UserError, match="another process is running in this folder"),
            locked(tmp_path),
        ):
            pass
    assert not list(tmp_path.iterdir())


def test_who_may_wait_has_the_folder_next(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with ExitStack() as first:
        first.enter_context(locked(tmp_path))
        looks = iter(range(100))
        monkeypatch.setattr(time, "sleep", lambda _: first.close() if next(looks) == 50 else None)
        with locked(tmp_path, wait=60.0):
            assert is_locked(tmp_path)


def test_a_file_system_without_locks_is_reported_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As Lustre mounted without flock."""

    def refused(*args: Any) -> None:
        raise OSError(errno.ENOSYS, "Function not implemented")

    monkeypatch.setattr(fcntl, "flock", refused)
    monkeypatch.setattr(durable, "_reported", set())
    for _ in range(2):
        with locked(tmp_path):
            assert not is_locked(tmp_path)
    assert re.fullmatch(f"{tmp_path}: .* no locks; .*\n", capsys.readouterr().err)
    assert not list(tmp_path.iterdir())


def test_the_parts_of_a_killed_process_are_removed(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").touch()
    (tmp_path / ".summary.json.0123abcd.part").write_text("half")
    with locked(tmp_path):
        assert [each.name for each in sorted(tmp_path.iterdir())] == [".lock", "config.yaml"]


@pytest.mark.parametrize("make", [lambda file: file.mkdir(), lambda file: file.symlink_to("/x")])
def test_a_lock_that_is_no_file_is_refused(tmp_path: Path, make: Any) -> None:
    make(tmp_path / ".lock")
    assert not is_locked(tmp_path)
    with pytest.raises(OSError, match=r"\.lock"), locked(tmp_path):
        pass
