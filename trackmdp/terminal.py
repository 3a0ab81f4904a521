"""A terminal that may go: its connection is lost, or its window closed."""

from __future__ import annotations

import errno
import io
import sys
from typing import Any, TextIO


def outlast_terminal() -> None:
    """From now on what is printed to a terminal that is gone is dropped: a run has still to save its state."""
    sys.stdout, sys.stderr = map(_outlasting, (sys.stdout, sys.stderr))


def _outlasting(stream: TextIO) -> TextIO:
    if not stream.isatty() or not isinstance(stream, io.TextIOWrapper):
        return stream
    raw = io.BufferedWriter(_Terminal(stream.fileno(), "w", closefd=False))
    return io.TextIOWrapper(raw, stream.encoding, stream.errors, line_buffering=True)


class _Terminal(io.FileIO):
    def write(self, data: Any) -> int:
        try:
            return super().write(data)
        except OSError as error:
            if error.errno != errno.EIO:
                raise
            return memoryview(data).nbytes
