"""Ray's address before Ray itself is asked: what is no address, and where nothing listens."""

from __future__ import annotations

import os
import signal
import socket
import sys
from contextlib import nullcontext
from importlib.util import find_spec
from pathlib import Path
from unittest.mock import Mock

import pytest

from tests.helpers import later
from tests.typed import refused
from trackmdp.app.sweep import launchers
from trackmdp.cluster import joining, ray_options
from trackmdp.config.sweeping import RayConfig
from trackmdp.errors import Preempted, UserError
from trackmdp.signals import Signals, handled, stop

BLOCKS = "solve grid.size=4 partition.block=2"


@pytest.mark.parametrize("given", ["{free}", "auto", "127.0.0.1:99999"])
def test_where_nothing_listens_is_one_line_at_once(
    given: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))  # and does not listen
        address = f"127.0.0.1:{free.getsockname()[1]}"
        monkeypatch.setenv("RAY_ADDRESS", address)
        given = given.format(free=address)
        with (
            pytest.raises(
                UserError,
                match=f"x={given}: expected a Ray cluster .nothing listens there: [^\n]+$",
            ),
            joining("x", given),
        ):
            pytest.fail("asked Ray, which waits for minutes")


@pytest.mark.parametrize(
    ("words", "key"),
    [
        (BLOCKS, "partition.cluster"),
        ("train collector=ray", "collector.address"),
        ("train -m seed=0,1 hydra/launcher=ray", "hydra.launcher.address"),
    ],
)
@pytest.mark.parametrize("given", ["x", "ray//x:1", *later(["x:y", ":1", "a b:1"])])
def test_what_is_no_address_leaves_no_folder(
    words: str, key: str, given: str, empty_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert f"{key}={given}: expected" in refused(capsys, *words.split(), f"{key}='{given}'")


@pytest.mark.slow  # run where Ray is installed, as the slow tests are
@pytest.mark.skipif(find_spec("ray") is None, reason="ray is not installed")
@pytest.mark.parametrize(
    "words",
    [
        f"{BLOCKS} partition.cluster",
        "train grid.size=4 partition.block=2 partition.cluster",
        "train collector=ray collector.address",
        "train -m seed=0,1 hydra/launcher=ray hydra.launcher.address",
    ],
)
def test_without_its_cluster_a_command_leaves_no_folder(
    words: str, empty_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "expected a Ray cluster" in refused(
        capsys, *f"{words}=127.0.0.1:99999 quiet=true".split()
    )


def test_a_cluster_of_our_own_is_none_that_runs_already(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ray's default is to join one that it finds on this machine."""
    ray = Mock(**{"init.side_effect": ValueError})
    monkeypatch.setitem(sys.modules, "ray", ray)
    with pytest.raises(UserError):
        launchers.run_on_ray(
            RayConfig(address=None, num_cpus=3, cpus_per_run=1.0, gpus_per_run=0.0), []
        )
    asked = ray.init.call_args.kwargs
    assert (asked["address"], asked["num_cpus"]) == ("local", 3)


def test_a_cluster_that_is_joined_is_asked_for_no_resources() -> None:
    """Ray refuses words about them."""
    assert ray_options("auto", 3, 2**20) == {"address": "auto", "logging_level": "error"}
    assert ray_options("local", 3)["num_cpus"] == 3


@pytest.mark.parametrize("error", [RuntimeError, Exception, OSError, None])
def test_sigterm_that_ray_took_over_acts_as_before(error: type[Exception] | None) -> None:
    def begin() -> None:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        if error is not None:
            raise error

    told = OSError if error is OSError else error and UserError
    message = "x=null: expected a Ray cluster" if told is UserError else None
    before = signal.getsignal(signal.SIGTERM)
    try:
        with pytest.raises(told, match=message) if told else nullcontext(), joining("x", None):
            begin()
        assert signal.getsignal(signal.SIGTERM) == before
    finally:
        signal.signal(signal.SIGTERM, before)


@pytest.mark.parametrize("ends", [SystemExit(15), KeyboardInterrupt()])
def test_a_sweep_that_notes_sigterm_while_ray_starts_ends(ends: BaseException) -> None:
    """Ray did not start: the sweep cannot go on to its runs, nor end with a status of Ray's."""

    def of_ray(*_: object) -> None:
        raise ends

    with Signals() as noted, pytest.raises(Preempted, match="signal 15"), joining("x", None):
        signal.signal(signal.SIGTERM, of_ray)
        signal.raise_signal(signal.SIGTERM)
    assert noted.received == signal.SIGTERM


@pytest.mark.parametrize("ends", [SystemExit(15), KeyboardInterrupt(), None])
def test_sigterm_while_ray_starts_acts_as_before(ends: BaseException | None) -> None:
    """Ray's own handlers exit, and its waits turn any exit into a KeyboardInterrupt."""

    def of_ray(*_: object) -> None:
        if ends is not None:
            raise ends

    with (
        handled(stop, signal.SIGTERM),
        pytest.raises(Preempted, match="signal 15"),
        joining("x", None),
    ):
        signal.signal(signal.SIGTERM, of_ray)
        os.kill(os.getpid(), signal.SIGTERM)
