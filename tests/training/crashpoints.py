"""Training runs that end at one file operation after another: `python -m tests.training.crashpoints FOLDER MODE STEP`.

Each is a fork of this process, which has everything imported. In mode `kill` it gets SIGKILL there; in mode `power` all
bytes that no fsync has put on the disk are gone as well; in mode `error` the operation fails. The same words again must
then end with the same run. Prints one line per failure, and the number of points at last.
"""

from __future__ import annotations

import builtins
import errno
import io
import os
import shutil
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.training.runs import assert_same_run, train
from trackmdp.errors import RunError

OPERATIONS = ("link", "replace", "rename", "unlink", "fsync", "mkdir", "ftruncate")
LOGGED = (
    "log=[mcap]",
    "log.mcap.episodes=2",
    "log.mcap.evaluations=1",
    "evaluation.every=2",
    "checkpoint.every=512",
)
FAILURES = (errno.ENOSPC, errno.EIO, errno.EPERM)


def say(line: str) -> None:
    sys.stdout.write(f"{line}\n")


class Disk:
    """Counts the file operations below `folder`, and does `action` at number `at`."""

    def __init__(self, folder: Path, at: int, action: Callable[[], None]) -> None:
        self.folder, self.at, self.action, self.count = folder, at, action, 0
        self.synced: dict[int, int] = {}
        for name in OPERATIONS:
            setattr(os, name, self._counted(name, getattr(os, name)))
        real = io.open

        def opened(file: Any, mode: str = "r", *args: Any, **options: Any) -> Any:
            if isinstance(file, (str, os.PathLike)) and set(mode) & set("wax+"):
                self._event()
            return real(file, mode, *args, **options)

        io.open = builtins.open = opened  # type: ignore[assignment]

    def _event(self) -> None:
        self.count += 1
        if self.count == self.at:
            self.action()

    def _counted(self, name: str, real: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **options: Any) -> Any:
            self._event()
            result = real(*args, **options)
            if name == "fsync":
                found = os.fstat(args[0])
                self.synced[found.st_ino] = found.st_size
            return result

        return call

    def lose_power(self) -> None:
        """Cut each file to its length at its last fsync."""
        for file in self.folder.rglob("*"):
            if file.is_file() and file.stat().st_size > (
                kept := self.synced.get(file.stat().st_ino, 0)
            ):
                os.truncate(file, kept)


def fork(work: Callable[[], int]) -> int:
    """The exit status of `work` in a fork, minus the number of the signal that ended it."""
    pid = os.fork()
    if pid == 0:
        status = 70
        try:
            status = work()
        except RunError:
            status = 1
        except BaseException as error:
            say(f"{type(error).__name__}: {error}")
        sys.stdout.flush()
        os._exit(status)
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


def interrupted(folder: Path, at: int, mode: str) -> int:
    """A run that ends at operation `at`: its exit status; 0 where it has fewer operations than that."""

    def work() -> int:
        def action() -> None:
            if mode == "error":
                number = FAILURES[at % len(FAILURES)]
                raise OSError(number, os.strerror(number))
            if mode == "power":
                disk.lose_power()
            os.kill(os.getpid(), signal.SIGKILL)

        disk = Disk(folder, at, action)
        train(folder, *LOGGED)
        return 0 if disk.count >= at else 100

    return fork(work)


def resumed(folder: Path) -> int:
    """The exit status of the same words again."""

    def work() -> int:
        train(folder, *LOGGED, "resume=auto")
        return 0

    return fork(work)


def main(place: Path, mode: str, step: int) -> None:
    """Go through the points, every `step`-th of them."""
    whole, cut = place / "whole", place / "cut"
    train(whole, *LOGGED)
    point = 1
    while True:
        shutil.rmtree(cut, ignore_errors=True)
        cut.mkdir()
        status = interrupted(cut, point, mode)
        if status == 100:
            break
        # A failing operation may be got over, as where the log of episodes ends and the run goes on.
        if status not in ((0, 1) if mode == "error" else (-signal.SIGKILL,)):
            say(f"point {point}: status {status}")
        if (again := resumed(cut)) != 0:
            say(f"point {point}: typed again, status {again}")
        else:
            try:
                assert_same_run(cut, whole)
            except AssertionError as error:
                say(f"point {point}: not the same run: {error}")
        point += step
    say(f"{(point - 1) // step} points")


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]))
