"""Signals: requests to stop a run are acted upon between two iterations; the death of a worker at once."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from types import FrameType
from typing import Any, Self

from trackmdp.errors import Preempted

ENDING = (signal.SIGTERM, signal.SIGUSR1, signal.SIGHUP)
"""Signals of a scheduler, and of a terminal that is gone, which by themselves would end one process at once."""
HEARD = (*ENDING, signal.SIGINT)
"""Signals that ask a run to stop."""
_ONE = 2.0
"""Seconds in which two count as one: `timeout` and some schedulers signal the process, and then its group once more."""
_AGAIN = 20.0
"""Seconds after which a wait for a dead worker is interrupted once more; TorchRL ends the others within ten."""


@contextmanager
def handled(handler: Any, *numbers: signal.Signals) -> Iterator[None]:
    """Handle signals by `handler` inside; afterwards by the handlers from before, also if the body installs others.

    Outside the main thread nothing is changed. Where SIGHUP is ignored, as behind `nohup`, it stays so.
    """
    # Python allows signal.signal in the main thread alone; `train` called from another one runs without.
    main = threading.current_thread() is threading.main_thread()
    # All are known before the first is changed: from then on the handler may be called, and raise.
    before = {number: signal.getsignal(number) for number in numbers if main}
    if before.get(signal.SIGHUP) is signal.SIG_IGN:
        del before[signal.SIGHUP]
    try:
        for number in before:
            signal.signal(number, handler)
        yield
    finally:
        for number, former in before.items():
            if former is not None:  # a handler in C, which Python cannot put back
                signal.signal(number, former)


@contextmanager
def kept(number: signal.Signals) -> Iterator[None]:
    """Others may handle a signal inside; afterwards the handler from before does, also of one that came meanwhile.

    Outside the main thread nothing is changed.

    Raises:
        Preempted: others ended the body for it, and the handler from before only notes it.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    # The numbers of signals that come are written here, whatever handles them.
    came, note = os.pipe()
    os.set_blocking(note, False)
    former = signal.set_wakeup_fd(note, warn_on_full_buffer=False)
    try:
        with handled(signal.getsignal(number), number):
            yield
    finally:
        signal.set_wakeup_fd(former)
        os.write(note, b"\0")  # else reading would wait where none came
        heard = os.read(came, 2**16)
        os.close(came)
        os.close(note)
        if number in heard:
            signal.raise_signal(number)
            if isinstance(sys.exception(), (SystemExit, KeyboardInterrupt)):
                raise Preempted(number)


class Signals(ExitStack):
    """While entered, the signals of `HEARD` are noted in `received` instead of ending the process.

    A second signal of the same kind has its former effect: Ctrl-C immediately, the others if they come at least two
    seconds after the first. Outside the main thread no handler is installed.
    """

    def __init__(self) -> None:
        super().__init__()
        self.received = 0
        self._first: dict[signal.Signals, float] = {}

    def __enter__(self) -> Self:
        self._before = {number: signal.getsignal(number) for number in HEARD}
        self.enter_context(handled(self._note, *HEARD))
        return self

    def heard(self) -> bool:
        """Whether a signal came, or comes within a moment.

        A scheduler signals a whole group of processes; a worker may die of it before this process receives it.
        """
        # Half a second in all.
        for _ in range(20):
            if self.received:
                return True
            time.sleep(0.025)
        return False

    def _note(self, number: int, frame: FrameType | None) -> None:  # noqa: ARG002
        kind, now = signal.Signals(number), time.monotonic()
        if kind not in self._first:
            self._first[kind], self.received = now, number
        # After the first Ctrl-C its former handler is back, so that a second one interrupts at once: a user at a
        # terminal may not want to wait for the end of the iteration.
        if kind is signal.SIGINT or now - self._first[kind] >= _ONE:
            signal.signal(number, self._before[kind])
        if now - self._first[kind] >= _ONE:
            # Sent again, now that the former handler is back: this call of ours has consumed the signal.
            os.kill(os.getpid(), number)


def stop(number: int, frame: FrameType | None) -> None:  # noqa: ARG001
    """A handler for `handled`: it ends the work under way at once.

    Raises:
        Preempted: always.
    """
    raise Preempted(number)


def leave(number: int, frame: FrameType | None) -> None:  # noqa: ARG001
    """A handler for `handled`: it ends the process, which first takes away what is to go.

    Raises:
        SystemExit: always. Not `Preempted`, upon which a run saves its state: it may be amid an iteration.
    """
    raise SystemExit(128 + number)


class Watch(ExitStack):
    """While entered, the end of one of a collector's worker processes interrupts the call that waits for it.

    TorchRL looks for dead workers where it waits for a batch, but waits for ever where one should acknowledge new
    weights. Here SIGCHLD interrupts the wait. Outside the main thread, and without workers, nothing is done.
    """

    def __init__(self, processes: Iterable[Any]) -> None:
        super().__init__()
        self._processes = list(processes)
        self._waiting = False
        self._again: threading.Timer | None = None

    def __enter__(self) -> Self:
        if self._processes:
            self.enter_context(handled(self._heard, signal.SIGCHLD))
        return self

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
            if self._again:
                self._again.cancel()

    def _interrupt(self) -> None:
        self._waiting = True
        os.kill(os.getpid(), signal.SIGCHLD)

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
                # The code that was interrupted may have swallowed the exception, and would wait for ever.
                self._again = threading.Timer(_AGAIN, self._interrupt)
                self._again.daemon = True
                self._again.start()
                how = f"ended with status {code}"
                if code < 0:
                    how = f"was killed by {signal.Signals(-code).name}"
                raise RuntimeError(f"worker {index} {how}")
