"""What stands in a log: topics and their JSON schemas, the time line, sealed metadata, versions."""

from __future__ import annotations

import hashlib
import json
import platform
from importlib.metadata import version
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


def _object(title: str, **properties: Any) -> dict[str, Any]:
    return {"title": title, "type": "object", "properties": properties}


def _fields(kind: str, names: str) -> dict[str, Any]:
    """Properties of one type."""
    return {name: {"type": kind} for name in names.split()}


def _inner(kind: str, names: str) -> dict[str, Any]:
    """A property with properties of one type."""
    return {"type": "object", "properties": _fields(kind, names)}


_INTEGER = {"type": "integer"}


def _layer(title: str) -> tuple[str, dict[str, Any]]:
    place = {"position": _inner("number", "x y z"), "orientation": _inner("number", "x y z w")}
    field = {"type": "object", "properties": _fields("string", "name") | _fields("integer", "offset type")}
    return "foxglove.Grid", _object(
        f"{title}; the first row is the lowest",
        timestamp=_inner("integer", "sec nsec"),
        **_fields("string", "frame_id"),
        pose={"type": "object", "properties": place},
        column_count=_INTEGER,
        cell_size=_inner("number", "x y"),
        **_fields("integer", "row_stride cell_stride"),
        fields={"type": "array", "items": field},
        data={"type": "string", "contentEncoding": "base64"},
    )


SCHEMAS: dict[str, tuple[str, dict[str, Any]]] = {
    "/step": (
        "trackmdp.Step",
        _object(
            "One step: what was known and chosen before the move, what came of it after",
            **_fields("integer", "episode t n last_cell"),
            active={"type": "array", "items": _INTEGER},
            n_active=_INTEGER,
            forced={"type": "boolean"},
            **_fields("integer", "target target_x target_y obs"),
            **_fields("number", "reward ep_return"),
            **_fields("boolean", "first last"),
        ),
    ),
    "/grid": _layer("belief and policy of every cell, of large grids of the part where they are not 0"),
    "/active": _layer("the cells sensed, in the smallest rectangle around them"),
    "/target": _layer("the true cell of the target"),
    "/part": (
        "foxglove.FrameTransform",
        _object(
            "the middle of the part of a large grid that the target is in",
            timestamp=_inner("integer", "sec nsec"),
            **_fields("string", "parent_frame_id child_frame_id"),
            translation=_inner("number", "x y z"),
            rotation=_inner("number", "x y z w"),
        ),
    ),
    "/episode": (
        "trackmdp.Episode",
        _object(
            "One episode, at the time of its last step",
            episode=_INTEGER,
            seed={"type": "string"},
            **_fields("integer", "policy start length detections forced"),
            **_fields("boolean", "terminated truncated"),
            **_fields("string", "start_time end_time"),
            **_fields("number", "return"),
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
