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
        given, reason = "null" if address is None else address, " ".join(str(error).split())
        raise UserError(f"{key}={given}: expected a Ray cluster ({reason})") from error


def _answers(address: str | None) -> None:
    """Raise a ConnectionError where nothing at host:port answers as Ray does; for that Ray would wait for minutes."""
    host, _, port = (address or "").rpartition(":")
    if not host or not port.isdecimal():
        return
    try:
        stream = socket.create_connection((host.strip("[]"), int(port)), timeout=_PATIENCE)
    except (OSError, OverflowError) as error:  # OverflowError: a port above 65535
        raise ConnectionError(f"nothing listens there: {error}") from error
    with stream:
        if not _encrypted() and not _speaks_http2(stream):
            raise ConnectionError("what listens there is not Ray, or hangs")


def _encrypted() -> bool:
    """Whether Ray is told to use TLS, whose handshake needs certificates that only Ray knows of."""
    return os.environ.get("RAY_USE_TLS", "").lower() in ("1", "true")


def _speaks_http2(stream: socket.socket) -> bool:
    """Whether the other side greets as HTTP/2 asks (RFC 9113, 3.4), on which gRPC and so Ray is built."""
    # The first frame from either side holds its settings; a frame begins with its length (3 bytes), type and flags
    # (1 each) and stream (4). Ours is empty and of type 4.
    settings = b"\0\0\0\4\0\0\0\0\0"
    try:
        stream.sendall(b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + settings)
        with stream.makefile("rb") as answer:
            return answer.read(len(settings))[3:] == settings[3:]
    except OSError:  # nothing came in time, or the connection was closed
        return False
