"""Ray's address before Ray itself is asked: what is no address, and where nothing listens."""

from __future__ import annotations

import signal
import socket
from contextlib import nullcontext
from pathlib import Path

import pytest

from tests.typed import refused
from trackmdp.cluster import joining
from trackmdp.errors import UserError

BLOCKS = "solve grid.size=4 partition.block=2"


@pytest.mark.parametrize("given", ["{free}", "auto", "127.0.0.1:99999"])
def test_where_nothing_listens_is_one_line_at_once(given: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))  # and does not listen
        address = f"127.0.0.1:{free.getsockname()[1]}"
        monkeypatch.setenv("RAY_ADDRESS", address)
        given = given.format(free=address)
        with (
            pytest.raises(UserError, match=f"x={given}: expected a Ray cluster .nothing listens there: [^\n]+$"),
            joining("x", given),
        ):
            pytest.fail("asked Ray, which waits for minutes")


def test_what_listens_is_joined() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server, joining("x", f"127.0.0.1:{server.getsockname()[1]}"):
        pass


@pytest.mark.parametrize(
    ("words", "key"),
    [
        (BLOCKS, "partition.cluster"),
        ("train collector=ray", "collector.address"),
        ("train -m seed=0,1 hydra/launcher=ray", "hydra.launcher.address"),
    ],
)
@pytest.mark.parametrize("given", ["x", "x:y", ":1", "ray//x:1", "a b:1"])
def test_what_is_no_address_leaves_no_folder(
    words: str, key: str, given: str, empty_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert f"{key}={given}: expected" in refused(capsys, *words.split(), f"{key}='{given}'")


@pytest.mark.parametrize("error", [RuntimeError, OSError, None])
def test_sigterm_that_ray_took_over_acts_as_before(error: type[Exception] | None) -> None:
    def begin() -> None:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        if error is not None:
            raise error

    told = {RuntimeError: UserError, OSError: OSError, None: None}[error]
    before = signal.getsignal(signal.SIGTERM)
    try:
        with pytest.raises(told) if told else nullcontext(), joining("x", None):
            begin()
        assert signal.getsignal(signal.SIGTERM) == before
    finally:
        signal.signal(signal.SIGTERM, before)
