"""What stands in a log: topics and their JSON schemas, the time line, sealed metadata, versions."""

from __future__ import annotations

import hashlib
import json
import platform
from importlib.metadata import version
from importlib.resources import files
from typing import Any

from trackmdp import __version__

LOG_FORMAT = "3"
"""Version of this layout; a reader refuses any other."""

RUN, POLICY, END = "trackmdp.run", "trackmdp.policy", "trackmdp.end"
"""Names of the metadata records; a policy's is followed by its number."""

TICK_NS = 100_000_000
# 10^9 s after 1970, a day in September 2001: a fixed date, the same in every log.
_BASE_NS = 1_000_000_000 * 1_000_000_000
GAP = 10
"""Ticks between the last step of an episode and the first of the next."""


def time_of(tick: int) -> int:
    """Log time of a tick, ns: simulated, never the wall clock, so that the same seed gives the same file."""
    return _BASE_NS + tick * TICK_NS


def tick_of(log_time: int) -> int:
    """The tick of a log time."""
    return (log_time - _BASE_NS) // TICK_NS


_FIELDS = json.loads(files("trackmdp.episodes").joinpath("schemas.json").read_text(encoding="utf-8"))
"""Name of a schema -> its properties, in the order in which messages have them."""

_TOPICS = {
    "/step": ("trackmdp.Step", "One step: what was known and chosen before the move, what came of it after"),
    "/grid": (
        "foxglove.Grid",
        "belief and policy of every cell, of large grids of the part where they are not 0; the first row is the lowest",
    ),
    "/active": (
        "foxglove.Grid",
        "the cells sensed, in the smallest rectangle around them; the first row is the lowest",
    ),
    "/target": ("foxglove.Grid", "the true cell of the target; the first row is the lowest"),
    "/part": ("foxglove.FrameTransform", "the middle of the part of a large grid that the target is in"),
    "/episode": ("trackmdp.Episode", "One episode, at the time of its last step"),
}

SCHEMAS: dict[str, tuple[str, dict[str, Any]]] = {
    topic: (name, {"title": title, "type": "object", "properties": _FIELDS[name]})
    for topic, (name, title) in _TOPICS.items()
}
"""Topic -> (name of its schema, JSON schema), within the subset that viewers read: no null, no array of arrays.

Cells are numbered row by row from the top left; -1 stands for no cell: a target that exited, nothing observed.
"""

MODE = {"/step": {"mode": {"type": "integer"}}, "/episode": {"start_mode": {"type": "integer"}}}
"""Topic -> what its messages have besides, in logs of targets with a mode."""


def digest(content: bytes) -> str:
    """SHA-256 in hexadecimal digits."""
    return hashlib.sha256(content).hexdigest()


def seal(name: str, content: dict[str, str]) -> dict[str, str]:
    """Metadata with a digest of its name and of all it says, since the container has no checksum for it."""
    return content | {"sha256": _seal(name, content)}


def unsealed_record(name: str, content: dict[str, str]) -> dict[str, str] | None:
    """Metadata without its seal; None if it is not what was sealed."""
    plain = {key: value for key, value in content.items() if key != "sha256"}
    return plain if content.get("sha256") == _seal(name, plain) else None


def _seal(name: str, content: dict[str, str]) -> str:
    return digest(json.dumps([name, content], sort_keys=True).encode())


_PACKAGES = ("mcap", "numpy", "scipy", "tensordict", "torch", "torchrl")


def versions() -> dict[str, str]:
    """What a bit may depend on: versions of this package, of Python and of the packages below, and the processor."""
    ours = {"trackmdp": __version__, "python": platform.python_version(), "machine": platform.machine()}
    return ours | {name: version(name) for name in _PACKAGES}


def versions_apart(logged: dict[str, str]) -> str:
    """The versions in which a log's metadata differs from here, in words; empty if in none."""
    here = versions()
    return ", ".join(
        f"{name} {logged.get(name, 'unknown')} (here {value})"
        for name, value in here.items()
        if logged.get(name) != value
    )
