from __future__ import annotations

import itertools
import signal
import threading
from pathlib import Path
from typing import Any

import pytest

from tests.helpers import later
from trackmdp.app.cli import main
from trackmdp.errors import Preempted
from trackmdp.signals import Signals, handled, stop


def test_the_first_signal_is_noted_and_a_later_one_acts_as_before(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    heard: list[int] = []
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    for number in before:
        signal.signal(number, lambda number, frame: heard.append(number))
    try:
        with Signals() as signals:
            assert signals.received == 0
            signal.raise_signal(signal.SIGTERM)
            signal.raise_signal(
                signal.SIGTERM
            )  # `timeout` signals the process, and then its group once more
            assert (signals.received, heard) == (signal.SIGTERM, [])
            monkeypatch.setattr("trackmdp.signals._ONE", 0.0)
            signal.raise_signal(signal.SIGTERM)
            assert heard == [signal.SIGTERM]
            monkeypatch.undo()
            signal.raise_signal(signal.SIGINT)
            assert (signals.received, heard) == (signal.SIGINT, [signal.SIGTERM])
            signal.raise_signal(signal.SIGINT)
            assert heard == [signal.SIGTERM, signal.SIGINT]
        assert signals.heard()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def at_installing(monkeypatch: pytest.MonkeyPatch, number: signal.Signals) -> None:
    """The signal comes as soon as its handler is changed for the first time."""
    put, changes = signal.signal, itertools.count()

    def putting(changed: signal.Signals, handler: Any) -> Any:
        former = put(changed, handler)
        if changed is number and next(changes) == 0:
            signal.raise_signal(number)
        return former

    monkeypatch.setattr(signal, "signal", putting)


def test_a_signal_while_handlers_are_installed_is_noted(monkeypatch: pytest.MonkeyPatch) -> None:
    with handled(lambda *_: None, signal.SIGINT):
        at_installing(monkeypatch, signal.SIGINT)
        with Signals() as signals:
            assert signals.received == signal.SIGINT


def test_a_signal_while_handlers_are_installed_leaves_none_of_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    before = signal.getsignal(signal.SIGTERM)
    at_installing(monkeypatch, signal.SIGTERM)
    with pytest.raises(Preempted), handled(stop, signal.SIGTERM, signal.SIGUSR1):
        pass
    assert signal.getsignal(signal.SIGTERM) == before


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


@pytest.mark.parametrize("number", [signal.SIGTERM, *later([signal.SIGUSR1, signal.SIGHUP])])
@pytest.mark.parametrize(
    ("place", "words"),
    [
        ("trackmdp.training.trainer.seed_global", "hydra.run.dir="),
        ("trackmdp.app.launch.read_write", "hydra.run.dir="),
        ("trackmdp.app.prepare.os.access", "hydra.run.dir="),
        ("trackmdp.app.sweep.sweep.sweep", "-m hydra.sweep.dir="),
        ("trackmdp.app.sweep.sweep.locked", "-m hydra.sweep.dir="),
    ],
)
def test_before_training_a_signal_leaves_no_folder(
    place: str,
    words: str,
    number: signal.Signals,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(place, lambda *_: signal.raise_signal(number))
    folder = tmp_path / "a" / "b"
    with handled(lambda *_: None, number):
        status = main(["train", "grid.size=3", "quiet=true", *f"{words}{folder}".split()])
    assert status == 128 + number
    assert capsys.readouterr().err == f"trackmdp train: stopped by signal {int(number)}\n"
    assert not folder.parent.exists()
