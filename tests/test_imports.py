"""Imports without the garbage collector, and Ctrl-C amid the first of them."""

from __future__ import annotations

import gc
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from trackmdp.app.cli import main
from trackmdp.imports import importing
from trackmdp.signals import handled


@pytest.fixture(autouse=True)
def thawed() -> Iterator[None]:
    yield
    gc.unfreeze()
    gc.enable()


def test_nothing_is_collected_inside_and_what_is_there_stays_out_of_later_collections() -> None:
    seen: list[str] = []
    gc.callbacks.append(lambda phase, _: seen.append(phase))
    try:
        with importing():
            kept = [[each] for each in range(200_000)]
            assert seen == []
    finally:
        gc.callbacks.pop()
    assert gc.get_freeze_count() >= len(kept)
    assert gc.isenabled()


def test_a_failed_import_leaves_the_collector_as_it_was() -> None:
    with pytest.raises(ImportError), importing():
        raise ImportError
    assert gc.isenabled()
    gc.disable()
    with importing():
        pass
    assert not gc.isenabled()


def test_ctrl_c_inside_counts_at_the_end_and_a_second_one_at_once() -> None:
    passed = []
    with handled(signal.default_int_handler, signal.SIGINT):
        with pytest.raises(KeyboardInterrupt), importing():
            signal.raise_signal(signal.SIGINT)
            passed.append("first")
        with pytest.raises(KeyboardInterrupt), importing():
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)
            passed.append("second")
    assert passed == ["first"]


INTERRUPTED = """
import runpy, signal, sys
class Interrupting:
    def find_spec(name, *_):
        if name == "trackmdp.untrusted":
            signal.raise_signal(signal.SIGINT)
sys.meta_path.insert(0, Interrupting)
runpy.run_module("trackmdp", run_name="__main__")
"""


def test_ctrl_c_while_the_command_line_is_imported_shows_no_traceback() -> None:
    done = subprocess.run(
        [sys.executable, "-c", INTERRUPTED], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (-signal.SIGINT, "")


BESIDE_THE_COMMAND = """
import atexit, runpy, signal, sys
from trackmdp.app import cli
def interrupt(): signal.raise_signal(signal.SIGINT)
{}
sys.argv[1:] = ["--version"]
runpy.run_module("trackmdp", run_name="__main__")
"""


@pytest.mark.parametrize(
    ("moment", "status"),
    [("cli.leave_current_folder = interrupt", 130), ("atexit.register(interrupt)", -signal.SIGINT)],
)
def test_ctrl_c_before_and_after_the_command_shows_no_traceback(moment: str, status: int) -> None:
    done = subprocess.run(
        [sys.executable, "-c", BESIDE_THE_COMMAND.format(moment)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (status, "")


def test_commands_leave_it_on() -> None:
    assert main(["train", "grid.size=0"]) == 2
    assert gc.isenabled() and gc.get_freeze_count() > 0


@pytest.mark.slow
def test_with_warnings_as_errors_a_run_is_not_stopped_by_torchrls_own(tmp_path: Path) -> None:
    words = "train algo.total_frames=1000 algo.frames_per_batch=1000 grid.size=3"
    command = [sys.executable, "-W", "error", "-m", "trackmdp", *words.split()]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
