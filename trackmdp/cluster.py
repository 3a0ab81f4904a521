"""Ray clusters: how an address is written, and one line where none can be joined."""

from __future__ import annotations

import os
import signal
import socket
from collections.abc import Iterator
from contextlib import chdir, contextmanager
from pathlib import Path

from trackmdp.errors import UserError
from trackmdp.imports import safe_children
from trackmdp.signals import handled

ADDRESS = r"auto|(\[[\da-fA-F:.]+\]|[\w.-]+):\d{1,5}"
"""Pattern of the address of a cluster: host:port, or `auto` for the one in RAY_ADDRESS."""
_PATIENCE = 5.0
"""Seconds in which a machine answers; Ray itself would wait for minutes."""


@contextmanager
def joining(key: str, address: str | None) -> Iterator[None]:
    """While Ray joins the cluster at `address`, or starts one; the signal of a scheduler still reaches the run.

    Raises:
        UserError: there is no such cluster; the message names the option `key`.
    """
    try:
        _reach(os.environ.get("RAY_ADDRESS") if address == "auto" else address)
        # Ray installs a handler of its own, which exits: a run would end without its checkpoint. And it puts the
        # present current folder first on its workers' path: a `random.py` there would run in them.
        with (
            handled(signal.getsignal(signal.SIGTERM), signal.SIGTERM),
            safe_children(),
            chdir(Path(__file__).parents[1]),
        ):
            yield
    except (ConnectionError, ValueError, RuntimeError) as error:
        given, reason = "null" if address is None else address, " ".join(str(error).split())
        raise UserError(f"{key}={given}: expected a Ray cluster ({reason})") from error


def _reach(address: str | None) -> None:
    """Raise a ConnectionError where nothing listens at host:port."""
    host, _, port = (address or "").rpartition(":")
    if host and port.isdecimal():
        try:
            socket.create_connection((host.strip("[]"), int(port)), timeout=_PATIENCE).close()
        except (OSError, OverflowError) as error:  # OverflowError: a port above 65535
            raise ConnectionError(f"nothing listens there: {error}") from error
