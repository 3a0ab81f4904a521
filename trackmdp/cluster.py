"""Ray clusters: how an address is written, and one line where none can be joined."""

from __future__ import annotations

import os
import signal
import socket
from collections.abc import Iterator
from contextlib import contextmanager

from trackmdp.errors import UserError
from trackmdp.signals import handled

ADDRESS = r"auto|(\[[\da-fA-F:.]+\]|[\w.-]+):\d{1,5}"
"""What may be given as the address of a cluster, as a pattern: the one that RAY_ADDRESS names, or host:port."""
_PATIENCE = 5.0
"""Seconds in which a machine answers."""


@contextmanager
def joining(key: str, address: str | None) -> Iterator[None]:
    """While Ray joins the cluster at `address`, or starts one; the signal of a scheduler still reaches the run.

    Raises:
        UserError: there is no such cluster; the message names the option `key`.
    """
    try:
        _answers(os.environ.get("RAY_ADDRESS") if address == "auto" else address)
        # Ray installs a handler of its own, which exits: a run would end without its checkpoint.
        with handled(signal.getsignal(signal.SIGTERM), signal.SIGTERM):
            yield
    except (ConnectionError, ValueError, RuntimeError) as error:  # RuntimeError: of another version of Ray
        reason = " ".join(str(error).split())
        raise UserError(f"{key}={address}: expected a Ray cluster ({reason})") from error


def _answers(address: str | None) -> None:
    """Raise a ConnectionError where nothing listens at host:port, for whose answer Ray would wait for minutes."""
    host, _, port = (address or "").rpartition(":")
    if host and port.isdecimal():
        try:
            socket.create_connection((host.strip("[]"), int(port)), timeout=_PATIENCE).close()
        except (OSError, OverflowError) as error:  # OverflowError: a port above 65535
            raise ConnectionError(f"nothing listens there: {error}") from error
