"""What stands in a log: topics and their JSON schemas, the time line, sealed metadata, versions."""

from __future__ import annotations

import hashlib
import json
import platform
from importlib.metadata import version
from typing import Any

from trackmdp import __version__

LOG_FORMAT = "2"
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


def _object(title: str, **properties: Any) -> dict[str, Any]:
    return {"title": title, "type": "object", "properties": properties}


_NUMBER, _INTEGER, _BOOLEAN, _STRING = ({"type": kind} for kind in ("number", "integer", "boolean", "string"))
_XY = {"type": "object", "properties": {"x": _NUMBER, "y": _NUMBER}}
_XYZ = {"type": "object", "properties": {"x": _NUMBER, "y": _NUMBER, "z": _NUMBER}}
_XYZW = {"type": "object", "properties": {"x": _NUMBER, "y": _NUMBER, "z": _NUMBER, "w": _NUMBER}}
_TIME = {"type": "object", "properties": {"sec": _INTEGER, "nsec": _INTEGER}}
_FIELD = {"type": "object", "properties": {"name": _STRING, "offset": _INTEGER, "type": _INTEGER}}


def _layer(title: str) -> tuple[str, dict[str, Any]]:
    return "foxglove.Grid", _object(
        f"{title}; the first row is the lowest",
        timestamp=_TIME,
        frame_id=_STRING,
        pose={"type": "object", "properties": {"position": _XYZ, "orientation": _XYZW}},
        column_count=_INTEGER,
        cell_size=_XY,
        row_stride=_INTEGER,
        cell_stride=_INTEGER,
        fields={"type": "array", "items": _FIELD},
        data={"type": "string", "contentEncoding": "base64"},
    )


SCHEMAS: dict[str, tuple[str, dict[str, Any]]] = {
    "/step": (
        "trackmdp.Step",
        _object(
            "One step: what was known and chosen before the move, what came of it after",
            episode=_INTEGER,
            t=_INTEGER,
            n=_INTEGER,
            last_cell=_INTEGER,
            active={"type": "array", "items": _INTEGER},
            n_active=_INTEGER,
            forced=_BOOLEAN,
            target=_INTEGER,
            target_x=_INTEGER,
            target_y=_INTEGER,
            obs=_INTEGER,
            reward=_NUMBER,
            ep_return=_NUMBER,
            first=_BOOLEAN,
            last=_BOOLEAN,
        ),
    ),
    "/grid": _layer("belief and policy of every cell, of large grids of the part where they are not 0"),
    "/active": _layer("the cells sensed, in the smallest rectangle around them"),
    "/target": _layer("the true cell of the target"),
    "/episode": (
        "trackmdp.Episode",
        _object(
            "One episode, at the time of its last step",
            episode=_INTEGER,
            seed=_STRING,
            policy=_INTEGER,
            start=_INTEGER,
            length=_INTEGER,
            detections=_INTEGER,
            forced=_INTEGER,
            terminated=_BOOLEAN,
            truncated=_BOOLEAN,
            start_time=_STRING,
            end_time=_STRING,
            **{"return": _NUMBER},
        ),
    ),
}
"""Topic -> (name of its schema, JSON schema), within the subset that viewers read: no null, no array of arrays.

Cells are numbered row by row from the top left; -1 stands for no cell: a target that exited, nothing observed.
"""

MODE = {"/step": {"mode": _INTEGER}, "/episode": {"start_mode": _INTEGER}}
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
