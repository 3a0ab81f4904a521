"""Errors that stop a command without being a bug."""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path

FAILED, USER_MISTAKE, INTERRUPTED = 1, 2, 130
"""Exit statuses of a command: a bug or a run that broke down, a user's mistake, Ctrl-C."""


class UserError(ValueError):
    """A mistake in the user's input; the message names the place, the value and the expectation.

    The command line prints the message as one line and exits with status 2. It is a `ValueError`, never
    `SystemExit`, so that one bad job does not end a whole Hydra sweep.
    """

    def __init__(self, message: str) -> None:
        # The text of what was given, such as an array or a world, may have several lines.
        super().__init__(" ".join(line.strip() for line in message.splitlines()))


class OutputError(UserError, OSError):
    """A file that is to be written has no place; an `OSError`, since within a run its folder went away."""


class RunError(RuntimeError):
    """A run that cannot go on: a loss that is not finite, a full disk, a worker that died.

    The command line prints the message as one line and exits with status 1.
    """


class Preempted(BaseException):
    """A signal ended a run between two iterations, after its checkpoint was saved.

    The command line exits with status 128 + the signal's number, so that schedulers see no failure. It is
    no `Exception`: it ends a whole sweep, not one job of it.
    """

    def __init__(self, signal: int) -> None:
        super().__init__(
            signal
        )  # the arguments alone go through a pickle, from a worker to whom it works for
        self.signal = signal

    def __str__(self) -> str:
        return f"stopped by signal {self.signal}"


def path_of(given: object, name: str) -> Path:
    """The path that was given for `name` from Python.

    Raises:
        UserError: it is no path.
    """
    if not isinstance(given, (str, os.PathLike)):
        raise UserError(f"{name}: a {type(given).__name__}, expected a path")
    return Path(given)


def output_of(given: object, name: str) -> Path:
    """The path of a file that `name` is to write.

    Raises:
        UserError: it is no path.
        OutputError: it is a folder or a device, or lies in no folder that can be written to.
    """
    path = path_of(given, name)
    # A device would be replaced by the file. With the dot a file is not taken for a folder.
    if path.exists() != path.is_file() or not os.access(f"{path.parent}/.", os.W_OK | os.X_OK):
        raise OutputError(f"{name}: {path}, expected a file in a folder that can be written to")
    return path


def message_of(error: BaseException) -> str:
    """The first line of an error's message, or the name of its class."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0].strip()


def adding(extra: str) -> str:
    """The line that installs an extra: in the clone that this package is imported from, or by the package's name."""
    clone = Path(__file__).parents[1]
    package = (
        f"-e '{clone}[{extra}]'" if (clone / "pyproject.toml").is_file() else f"'trackmdp[{extra}]'"
    )
    return f"pip install {package}"


def require(module: str, extra: str, option: str) -> None:
    """Refuse `option` where the third-party `module`, which comes with the extra `trackmdp[extra]`, is not installed.

    Raises:
        UserError: it is not.
    """
    if importlib.util.find_spec(module) is None:
        raise UserError(f"{option}: needs {module}, which {adding(extra)} adds")
