"""Imports: without the garbage collector, and in child processes never from the current folder."""

from __future__ import annotations

import gc
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from trackmdp.signals import Signals


@contextmanager
def importing() -> Iterator[None]:
    """Collect no garbage inside, and exempt all objects there at the end from later collections.

    torch and TorchRL make more than half a million objects that stay; the collector would look through them time and
    again, for a sixth of the time that a command takes to start.

    A signal counts at the end, a second Ctrl-C at once: in a callback of Python's import locks it would be printed as
    a traceback, and lost.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        with Signals() as signals:
            yield
        if signals.received:
            signal.raise_signal(signals.received)
    finally:
        gc.freeze()
        if enabled:
            gc.enable()


@contextmanager
def safe_children() -> Iterator[None]:
    """Processes that are started inside do not import modules from the current folder.

    `multiprocessing` starts a child as ``python -c ...``, which puts the current folder first on `sys.path`: a file
    `random.py` that came with somebody's data would run in place of Python's own module. `PYTHONSAFEPATH` (Python 3.11)
    leaves that folder out; children inherit it.
    """
    before = os.environ.get("PYTHONSAFEPATH")
    os.environ["PYTHONSAFEPATH"] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ["PYTHONSAFEPATH"]
        else:
            os.environ["PYTHONSAFEPATH"] = before


def leave_current_folder() -> None:
    """Take the current folder off `sys.path`, where ``python -m`` puts it first and children inherit it."""
    with suppress(FileNotFoundError):  # the current folder was removed
        if not sys.flags.safe_path and sys.path[0] == str(Path.cwd()):
            del sys.path[0]
    # In a clone that is not installed, the package was found in that folder.
    if (package := str(Path(__file__).parents[1])) not in sys.path:
        sys.path.append(package)
