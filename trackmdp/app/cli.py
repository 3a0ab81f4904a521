"""The command `trackmdp`: `trackmdp train grid.size=5`, also reached as `python scripts/train.py grid.size=5`.

Nothing heavy is imported before the first line is on the terminal; a user's mistake ends in one line and status 2.
"""

from __future__ import annotations

import errno
import os
import sys
import traceback

from trackmdp import __version__
from trackmdp.errors import FAILED, INTERRUPTED, USER_MISTAKE, Preempted, RunError, UserError

__all__ = ["COMMANDS", "main"]

COMMANDS = {
    "train": "learn a sensing policy without the motion model, and evaluate it exactly",
    "evaluate": "value a trained policy or a baseline, exactly and by simulation",
    "solve": "solve a world with its motion model",
    "verify": "check the paper's theorems on a world",
    "benchmark": "measure speed and quality on this machine",
    "export": "write a learned policy as a file that runs without this package",
    "replay": "list, play, verify and recover logged episodes, or show one as a web page",
    "report": "make figures, tables and a web page of a sweep, or watch it run",
}


_OF_FILES = {
    getattr(errno, name)
    for name in ("EACCES", "EDQUOT", "EISDIR", "ELOOP", "ENAMETOOLONG", "ENOSPC", "ENOTDIR", "EPERM", "EROFS")
}
"""What the file system refuses, whoever wrote the code: its own words are enough."""


def main(argv: list[str] | None = None) -> int:
    """Run one command; returns the exit status: 0, or one of `trackmdp.errors`, or 128 + the signal that ended it."""
    words = sys.argv[1:] if argv is None else argv
    os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")  # TorchRL reports every buffer it makes
    try:
        status = _dispatch(words)
        sys.stdout.flush()
        return status
    except BrokenPipeError:  # `trackmdp train --help | head`: nobody listens any more
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
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
        if command not in COMMANDS:
            raise UserError(f"unknown command {command!r}: expected one of {', '.join(COMMANDS)}")
        return _run(command, words[1:])
    except KeyboardInterrupt:
        sys.stderr.write(f"trackmdp {command}: interrupted\n")
        return INTERRUPTED
    except Preempted as error:
        sys.stderr.write(f"trackmdp {command}: {error}\n")
        return 128 + error.signal
    except (UserError, RunError) as error:
        if os.environ.get("HYDRA_FULL_ERROR") == "1":
            traceback.print_exc()
        name = f"trackmdp {command}" if command in COMMANDS else "trackmdp"
        sys.stderr.write(f"{name}: {_printable(str(error))}\n")
        return USER_MISTAKE if isinstance(error, UserError) else FAILED
    except BrokenPipeError:
        raise
    except OSError as error:
        if error.filename is None or error.errno not in _OF_FILES:
            traceback.print_exc()
        else:
            sys.stderr.write(f"trackmdp {command}: {_printable(f'{error.filename}: {error.strerror}')}\n")
        return FAILED
    except (MemoryError, RuntimeError) as error:
        if not isinstance(error, MemoryError) and "can't allocate memory" not in str(error):  # torch's own words
            traceback.print_exc()
        else:
            sys.stderr.write(f"trackmdp {command}: not enough memory for what is asked for\n")
        return FAILED
    except Exception:  # a bug: whoever reads it needs all of it
        traceback.print_exc()
        return FAILED


def _run(command: str, words: list[str]) -> int:
    if "-h" in words or "--help" in words:
        from trackmdp.app.manual import manual

        sys.stdout.write(manual(command, [word for word in words if not word.startswith("-")]))
        return 0
    from trackmdp.app.launch import launch

    return launch(command, words)


def _printable(text: str) -> str:
    """`text` in one line; what a terminal would obey, such as an escape sequence in a file's name, is spelled out."""
    return "".join(each if each.isprintable() else ascii(each)[1:-1] for each in " ".join(text.split()))


def _overview() -> str:
    width = max(map(len, COMMANDS))
    lines = [f"  {name:<{width}}  {text}" for name, text in COMMANDS.items()]
    return "\n".join(
        [
            "usage: trackmdp COMMAND [option=value ...]",
            "",
            *lines,
            "",
            "trackmdp COMMAND --help lists every option of a command.",
            "",
        ]
    )


if __name__ == "__main__":
    sys.exit(main())
