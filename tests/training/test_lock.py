"""One process per folder, also where the file system has no locks."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import socket
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from trackmdp.errors import UserError
from trackmdp.training import lock
from trackmdp.training.lock import is_locked, locked

OWNER = ".lock.owner"


@pytest.fixture
def lockless(monkeypatch: pytest.MonkeyPatch) -> None:
    """A file system such as Lustre mounted without flock."""

    def refused(*args: Any) -> None:
        raise OSError(errno.ENOSYS, "Function not implemented")

    monkeypatch.setattr(fcntl, "flock", refused)
    monkeypatch.setattr(lock, "_SETTLE", 0.01)


def owned(folder: Path, **said: Any) -> Path:
    """What an owner leaves that was killed."""
    file = folder / OWNER
    file.write_text(json.dumps({"token": "x", "host": socket.gethostname(), "pid": os.getpid()} | said))
    return file


def test_a_folder_is_held_once(tmp_path: Path) -> None:
    assert not is_locked(tmp_path)
    with locked(tmp_path):
        assert is_locked(tmp_path)
        with pytest.raises(UserError, match="another process is running in this folder"), locked(tmp_path):
            pass
    assert not list(tmp_path.iterdir())


def test_who_may_wait_has_the_folder_next(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with ExitStack() as first:
        first.enter_context(locked(tmp_path))
        looks = iter(range(100))
        monkeypatch.setattr(time, "sleep", lambda _: first.close() if next(looks) == 50 else None)
        with locked(tmp_path, wait=60.0):
            assert is_locked(tmp_path)


@pytest.mark.usefixtures("lockless")
def test_without_locks_a_file_names_the_owner(tmp_path: Path) -> None:
    with locked(tmp_path):
        assert is_locked(tmp_path)
        with pytest.raises(UserError, match=rf"another process .*\(process {os.getpid()} on "), locked(tmp_path):
            pass
    assert not is_locked(tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("lockless")
def test_an_owner_that_was_killed_is_noticed_at_once(tmp_path: Path) -> None:
    gone = os.posix_spawn("/bin/true", ["true"], {})
    os.waitpid(gone, 0)
    owned(tmp_path, pid=gone)
    assert not is_locked(tmp_path)
    with locked(tmp_path):
        assert is_locked(tmp_path)


@pytest.mark.usefixtures("lockless")
def test_an_owner_on_another_host_counts_as_gone_after_a_silence(tmp_path: Path) -> None:
    file = owned(tmp_path, host="elsewhere")
    with pytest.raises(UserError, match="on elsewhere"), locked(tmp_path):
        pass
    old = time.time() - 2 * lock._SILENT
    os.utime(file, (old, old))
    with locked(tmp_path):
        assert json.loads(file.read_text())["pid"] == os.getpid()


@pytest.mark.usefixtures("lockless")
def test_an_owner_gives_signs_of_life(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lock, "_BEAT", 0.02)
    with locked(tmp_path):
        os.utime(tmp_path / OWNER, (1, 1))
        for _ in range(200):
            time.sleep(0.02)
            if (tmp_path / OWNER).stat().st_mtime > 1:
                return
    pytest.fail("the file was never touched")


@pytest.mark.parametrize("make", [lambda file: file.mkdir(), os.mkfifo, lambda file: file.symlink_to("/etc/hostname")])
def test_a_lock_that_is_no_file_is_refused(tmp_path: Path, make: Any) -> None:
    make(tmp_path / ".lock")
    assert not is_locked(tmp_path)
    with pytest.raises(UserError, match="expected an ordinary file"), locked(tmp_path):
        pass
