from __future__ import annotations

import signal
import threading
from contextlib import nullcontext

import pytest

from trackmdp.training.signals import Signals, kept_sigterm


def test_the_first_signal_is_noted_and_the_second_acts_as_before() -> None:
    before = signal.getsignal(signal.SIGUSR1)
    with Signals() as signals:
        assert signals.received == 0
        signal.raise_signal(signal.SIGUSR1)
        assert (signals.received, signal.getsignal(signal.SIGUSR1)) == (signal.SIGUSR1, before)
        signal.raise_signal(signal.SIGTERM)
        assert signals.received == signal.SIGTERM
    assert signal.getsignal(signal.SIGTERM) != signals._note


def test_outside_the_main_thread_signals_are_not_touched() -> None:
    seen = []

    def enter() -> None:
        with Signals():
            seen.append(signal.getsignal(signal.SIGTERM))

    before = signal.getsignal(signal.SIGTERM)
    thread = threading.Thread(target=enter)
    thread.start()
    thread.join()
    assert seen == [before]


@pytest.mark.parametrize("error", [RuntimeError, None])
def test_sigterm_that_a_library_took_over_acts_as_before(error: type[Exception] | None) -> None:
    def begin() -> None:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        if error is not None:
            raise error

    before = signal.getsignal(signal.SIGTERM)
    try:
        with pytest.raises(error) if error else nullcontext(), kept_sigterm():
            begin()
        assert signal.getsignal(signal.SIGTERM) == before
    finally:
        signal.signal(signal.SIGTERM, before)
