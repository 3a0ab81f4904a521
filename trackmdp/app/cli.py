"""The command `trackmdp`: `trackmdp train grid.size=5`, also reached as `python scripts/train.py grid.size=5`.

Nothing heavy is imported before the first line is on the terminal; a user's mistake ends in one line and status 2.
"""

from __future__ import annotations

import errno
import io
import os
import platform
import signal
import sys
import traceback
from pathlib import Path

from trackmdp import __version__
from trackmdp.errors import FAILED, INTERRUPTED, USER_MISTAKE, Preempted, RunError, UserError
from trackmdp.imports import importing, leave_current_folder
from trackmdp.terminal import outlast_terminal
from trackmdp.untrusted import printable

COMMANDS = {
    "train": "learn a policy without the motion model, and evaluate it exactly",
    "evaluate": "value a trained policy or a baseline, exactly and by simulation",
    "compare": "set policies side by side, with the differences and their intervals",
    "solve": "solve a world with its motion model",
    "frontier": "find the best accuracy for every number of sensors per step",
    "verify": "check the paper's theorems on a world",
    "export": "write a learned policy as a file that runs without this package",
    "replay": "list, play, verify, recover logged episodes, or show one as a page",
    "report": "make figures, tables and a web page of a sweep, or watch it run",
}

_NO_MEMORY = ("can't allocate memory", "failed to map segment")
"""Words of torch, in a RuntimeError, and of the system's loader, in an ImportError."""


def main(argv: list[str] | None = None) -> int:
    """Run one command; returns the exit status: 0, or one of `trackmdp.errors`, or 128 + the signal that ended it."""
    words = sys.argv[1:] if argv is None else argv
    # `>&-`: what is printed is dropped, and no file of a run becomes descriptor 1 or 2, where libraries print.
    sys.stdout, sys.stderr = (
        stream or os.fdopen(os.open(os.devnull, os.O_WRONLY), "w")
        for stream in (sys.stdout, sys.stderr)
    )
    # A terminal that has no `±` shows `?`; by default Python raises. The variable is for processes started from here.
    os.environ.setdefault("PYTHONIOENCODING", ":replace")
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")
    # Set before TorchRL and NumPy are imported, which read them then.
    os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")  # TorchRL reports every buffer it makes
    # Shared out to more threads, by default to all cores, sums round differently: the last digits of exact figures
    # would depend on the machine. `threads` is about torch alone.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Every process that the command starts inherits it; see `trackmdp.imports.safe_children`.
    os.environ.setdefault("PYTHONSAFEPATH", "1")
    if argv is None:
        outlast_terminal()
        leave_current_folder()
    try:
        status = _dispatch(words)
        # Now, not at the interpreter's end: there a closed pipe could no longer be answered by an exit status.
        sys.stdout.flush()
        return status
    # The interpreter flushes stdout once more when it ends, and would complain again; so it is pointed at /dev/null.
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        # `trackmdp train --help | head`: nobody listens any more.
        if not isinstance(error, BrokenPipeError):
            sys.stderr.write(f"trackmdp: standard output: {error.strerror}\n")
        return FAILED


def _dispatch(words: list[str]) -> int:
    if not words or words[0] in ("-h", "--help"):
        sys.stdout.write(_overview())
        return 0
    if words[0] == "--version":
        sys.stdout.write(f"trackmdp {__version__}\n")
        return 0
    command = words[0]
    try:
        if command == "example":
            sys.stdout.write(_example(words[1:]))
            return 0
        if command not in COMMANDS:
            raise UserError(
                f"unknown command {command!r}: expected one of {', '.join([*COMMANDS, 'example'])}"
            )
        # Runs lock their folders and hear signals as POSIX has them; better here than in the middle of an import.
        if platform.system() == "Windows":
            raise UserError(
                "Windows is not supported: expected Linux or macOS, or Linux in WSL on Windows"
            )
        return _run(command, words[1:])
    except SystemExit as error:
        number = _signalled(error) - 128
        if number not in signal.valid_signals():  # argparse ends so after `--version`
            raise
        return _report(command, Preempted(number))
    except (Exception, KeyboardInterrupt, Preempted) as error:
        # Standard output has no file's name. If it has failed, it fails once more, which `main` reports.
        if isinstance(error, OSError) and not error.filename:
            sys.stdout.write("\n")
            sys.stdout.flush()
        return _report(command, error)


def _report(command: str, error: BaseException) -> int:
    """Print why a command ended, in one line unless it is a bug; returns the exit status."""
    line, status = str(error), FAILED
    if isinstance(error, Preempted):
        status = 128 + error.signal
    elif signalled := _signalled(error):
        line, status = "interrupted", signalled
    elif isinstance(error, (UserError, RunError)):
        status = USER_MISTAKE if isinstance(error, UserError) else FAILED
        if os.environ.get("HYDRA_FULL_ERROR") == "1":
            traceback.print_exception(error)
    # Without a file's name it is about no file of the user, and one of theirs that is missing is a `UserError`.
    elif isinstance(error, OSError) and error.filename and error.errno != errno.ENOENT:
        line = f"{error.filename}: {error.strerror}"
    elif isinstance(error, MemoryError) or any(words in line for words in _NO_MEMORY):
        line = "not enough memory"
    else:  # a bug: its reader needs all of it
        traceback.print_exception(error)
        return status
    name = f"trackmdp {command}" if command in COMMANDS else "trackmdp"
    # What Python calls by the command's name begins its messages with it.
    said = printable(" ".join(line.split())).removeprefix(f"{command}: ")
    sys.stderr.write(f"{name}: {said}\n")
    return status


def _signalled(error: BaseException | None) -> int:
    """The exit status of the signal that is behind an error; 0 where none is.

    Python 3.11 wraps Ctrl-C where a class is made, as while the config is imported; and OmegaConf, interrupted while it
    composes, fails on what is half made.
    """
    passed: set[int] = set()  # an error can be behind itself: `raise a from b`, where b came of a
    while error is not None and id(error) not in passed:
        if isinstance(error, KeyboardInterrupt):
            return INTERRUPTED
        if isinstance(error, SystemExit):  # of `trackmdp.signals.leave`
            return error.code if isinstance(error.code, int) else 0
        passed.add(id(error))
        error = error.__cause__ or error.__context__
    return 0


def _run(command: str, words: list[str]) -> int:
    try:
        Path.cwd()
    except FileNotFoundError:
        raise UserError("the current folder was removed, expected one that exists") from None
    if "-h" in words or "--help" in words:
        from trackmdp.app.manual import manual

        try:
            text = manual(command, _asked(words))
        except UserError as error:
            if not any(word.startswith(("--config-dir", "-cd")) for word in words):
                raise
            # Read by Hydra alone, which help does without.
            raise UserError(f"{error}; --cfg job shows a choice of --config-dir") from error
        sys.stdout.write(text)
        return 0
    with importing():
        from trackmdp.app.launch import launch

    return launch(command, words)


def _asked(words: list[str]) -> list[str]:
    """The words of a line that help is about: neither flags nor the value of one, as the folder of `--config-dir`."""
    alone = ("-h", "--help", "-m", "--multirun")
    return [
        word
        for before, word in zip(["", *words], words, strict=False)
        if not word.startswith("-") and ("=" in word or before in alone or before[:1] != "-")
    ]


def _example(names: list[str]) -> str:
    """The text of an example; without a name all names."""
    from trackmdp.examples import example_file, examples

    return (
        example_file(" ".join(names)).read_text("utf-8") if names else "\n".join([*examples(), ""])
    )


def _overview() -> str:
    width = max(map(len, COMMANDS))
    lines = "".join(f"  {name:<{width}}  {text}\n" for name, text in COMMANDS.items())
    last = (
        "trackmdp COMMAND --help: the options used most; --help all: all of them.\n"
        "trackmdp example: the names of the examples; trackmdp example NAME: its text."
    )
    return f"usage: trackmdp COMMAND [option=value ...]\n\n{lines}\n{last}\n"


if __name__ == "__main__":
    sys.exit(main())
