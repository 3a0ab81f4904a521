"""A collector's worker processes: one that dies is noticed at once, also while the collector waits for its answer."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

from torchrl.collectors import BaseCollector


class Watch:
    """While entered, the end of a worker process of `collector` interrupts the call that waits for it.

    TorchRL looks for dead workers where it waits for a batch, but waits for ever where one should acknowledge new
    weights. Here SIGCHLD interrupts the wait. Outside the main thread, and without workers, nothing is done.
    """

    def __init__(self, collector: BaseCollector) -> None:
        # TorchRL keeps them as `procs`; a collector in this process, or on Ray, has none.
        self._processes: list[Any] = list(getattr(collector, "procs", ()))
        self._waiting = False

    def __enter__(self) -> Watch:
        self._before: Any = None
        if self._processes and threading.current_thread() is threading.main_thread():
            self._before = signal.signal(signal.SIGCHLD, self._heard)
        return self

    def __exit__(self, *_: object) -> None:
        if self._before is not None:
            signal.signal(signal.SIGCHLD, self._before)

    @contextmanager
    def waiting(self) -> Iterator[None]:
        """Around a call of the collector.

        Raises:
            RuntimeError: a worker has died, before or meanwhile.
        """
        self._waiting = True
        try:
            self._check()
            yield
        finally:
            self._waiting = False

    def _heard(self, number: int, frame: FrameType | None) -> None:  # noqa: ARG002
        # Only while the collector waits: an exception out of a signal handler anywhere else, in the middle of an
        # optimizer step or of a saving, would leave half a state. A worker that dies at such a moment is found by the
        # next call.
        if self._waiting:
            self._check()

    def _check(self) -> None:
        for index, process in enumerate(self._processes):
            # `exitcode` raises on a process object that was closed. None: still running; negative: the number of the
            # signal that killed it.
            code = None if process._closed else process.exitcode
            if code is not None:
                self._waiting = False  # the others end next, when the collector is shut down
                how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with status {code}"
                raise RuntimeError(f"worker {index} {how}")
