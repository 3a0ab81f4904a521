"""Ray clusters: how an address is written, and one line where none can be joined."""

from __future__ import annotations

import os
import signal
import socket
from collections.abc import Iterator
from contextlib import chdir, contextmanager
from pathlib import Path
from typing import Any

from trackmdp.errors import UserError
from trackmdp.imports import safe_children
from trackmdp.signals import kept
from trackmdp.untrusted import reason

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
        with kept(signal.SIGTERM), safe_children(), chdir(Path(__file__).parents[1]):
            yield
    except Exception as error:
        # Ray raises a bare `Exception` where a node does not start in time.
        expected = isinstance(error, (ConnectionError, ValueError, RuntimeError))
        if not expected and type(error) is not Exception:
            raise
        given, why = "null" if address is None else address, reason(error)
        raise UserError(f"{key}={given}: expected a Ray cluster ({why})") from error


def ray_options(address: str | None, cores: int | None, store: int | None = None) -> dict[str, Any]:
    """Arguments of `ray.init`.

    Args:
        address: of the cluster to join; None or ``local`` to start one on this machine.
        cores: of a cluster started here; None for all.
        store: bytes for its objects; None for Ray's own choice.
    """
    quiet = {"logging_level": "error"}
    if address not in (None, "local"):
        return {"address": address} | quiet  # its resources were fixed when it was started
    # Without an address Ray would join a cluster that runs here, or the one that RAY_ADDRESS names.
    started = {"address": "local", "num_cpus": cores, "object_store_memory": store}
    return started | {"include_dashboard": False} | quiet


def _reach(address: str | None) -> None:
    """Raise a ConnectionError where nothing listens at host:port."""
    host, _, port = (address or "").rpartition(":")
    if host and port.isdecimal():
        try:
            socket.create_connection((host.strip("[]"), int(port)), timeout=_PATIENCE).close()
        except (OSError, OverflowError) as error:  # OverflowError: a port above 65535
            raise ConnectionError(f"nothing listens there: {error}") from error
