"""Format of a log: topics and their JSON schemas, the time line, sealed metadata, versions."""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import platform
from collections.abc import Mapping
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from typing import Any

from trackmdp import __version__
from trackmdp.config.several import MOST_TARGETS
from trackmdp.errors import UserError
from trackmdp.untrusted import decoded
from trackmdp.world.problem_file import PROBLEM

LOG_FORMAT = "5"
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


def clock_of(tick: int) -> dict[str, int]:
    """The same as seconds and nanoseconds."""
    seconds, rest = divmod(time_of(tick), 1_000_000_000)
    return {"sec": seconds, "nsec": rest}


def tick_of(log_time: int) -> int:
    """The tick of a log time."""
    return (log_time - _BASE_NS) // TICK_NS


_FIELDS = json.loads(
    files("trackmdp.episodes").joinpath("schemas.json").read_text(encoding="utf-8")
)
"""Name of a schema -> its properties, in the order in which messages have them."""

_GRID, _ROWS = "foxglove.Grid", "; the first row is the lowest"
_TOPICS = {
    "/step": (
        "trackmdp.Step",
        "One step: state and action before the move, outcome after it",
    ),
    "/grid": (
        "foxglove.Grid",
        f"belief and policy of every cell, of large grids of the part where they are not 0{_ROWS}",
    ),
    "/active": (_GRID, f"the cells sensed, in the smallest rectangle around them{_ROWS}"),
    "/target": (_GRID, f"the true cell of the target{_ROWS}"),
    "/part": (
        "foxglove.FrameTransform",
        "the middle of the part of a large grid that the target is in",
    ),
    "/episode": ("trackmdp.Episode", "One episode, at the time of its last step"),
}


def _schema(name: str, title: str) -> dict[str, Any]:
    return {"title": title, "type": "object", "properties": _FIELDS[name]}


SCHEMAS: dict[str, tuple[str, dict[str, Any]]] = {
    topic: (name, _schema(name, title)) for topic, (name, title) in _TOPICS.items()
}
"""Topic -> (name of its schema, JSON schema), within the subset that viewers read: no null, no array of arrays.

Cells are numbered row by row from the top left; -1 stands for no cell: a target that exited, nothing observed.
"""

_INTEGER = {"type": "integer"}
_EACH_TARGET = {"type": "array", "items": _INTEGER}
_OF_SEVERAL: dict[str, dict[str, Any]] = {
    "/step": dict.fromkeys(
        ("n", "last_cell", "target", "target_x", "target_y", "obs"), _EACH_TARGET
    )
    | {"n_present": _INTEGER},
    "/episode": {"start": _EACH_TARGET},
}
"""Topic -> properties of its messages, in logs of several targets."""


def _with(topic: str, fields: dict[str, Any], kind: str = ".") -> tuple[str, dict[str, Any]]:
    """The schema of a topic with other or further properties; `kind` takes the place of the point in its name."""
    name, said = SCHEMAS[topic]
    return name.replace(".", kind), said | {"properties": said["properties"] | fields}


def belief_topic(target: int) -> str:
    """The topic of where one of several targets is expected."""
    return f"/belief/{target}"


def schemas_of_several(targets: int) -> dict[str, tuple[str, dict[str, Any]]]:
    """`SCHEMAS` of a log of K targets."""
    scene = ("foxglove.SceneUpdate", _schema("foxglove.SceneUpdate", "the targets, by number"))
    single = {topic: SCHEMAS[topic] for topic in ("/grid", "/active", "/part")}
    of_each = {belief_topic(each): SCHEMAS["/grid"] for each in range(targets)}
    steps = {topic: _with(topic, fields, ".Group") for topic, fields in _OF_SEVERAL.items()}
    return steps | single | of_each | {"/targets": scene}


MODE = {"/step": {"mode": _INTEGER}, "/episode": {"start_mode": _INTEGER}}
"""Topic -> further properties of its messages, in logs of targets with a mode."""


_JSON = json.JSONEncoder(allow_nan=False, separators=(",", ":"))


def json_bytes(content: Any) -> bytes:
    """JSON without blanks.

    Raises:
        ValueError: a number is not finite.
    """
    return _JSON.encode(content).encode()


def digest(content: bytes) -> str:
    """SHA-256 in hexadecimal digits."""
    return hashlib.sha256(content).hexdigest()


def seal(name: str, content: Mapping[str, str]) -> dict[str, str]:
    """Metadata with a digest of its name and content, since the container has no checksum for it."""
    return {**content, "sha256": digest(json.dumps([name, content], sort_keys=True).encode())}


def unseal(name: str, content: Mapping[str, str]) -> dict[str, str]:
    """Metadata without its seal.

    Raises:
        ValueError: it differs from the metadata that was sealed.
    """
    plain = {key: value for key, value in content.items() if key != "sha256"}
    if seal(name, plain) != content:
        raise ValueError(f"the digest of metadata {name}")
    return plain


_PACKAGES = ("mcap", "numpy", "scipy", "tensordict", "torch", "torchrl")


def versions() -> dict[str, str]:
    """Versions that bits may depend on: of this package, Python, the packages below, and the processor."""
    ours = {
        "trackmdp": __version__,
        "python": platform.python_version(),
        "machine": platform.machine(),
    }
    return ours | {name: version(name) for name in _PACKAGES}


def versions_apart(logged: dict[str, str]) -> str:
    """The versions in which a log's metadata differs from here, in words; empty if in none."""
    apart = {name: here for name, here in versions().items() if logged.get(name) != here}
    return ", ".join(
        f"{name} {logged.get(name, 'unknown')} (here {here})" for name, here in apart.items()
    )


TABLES = ("config.yaml", PROBLEM)
"""Attachments that every log begins with: the run's config, and the world or the held-out tracks."""


def policy_file(number: int, kind: int = 0) -> str:
    """The attachment with the table of a policy; of several targets for one of their motions."""
    return f"policy-{number}.npz" if kind == 0 else f"policy-{number}-{kind}.npz"


def table_digest(kind: int) -> str:
    """The entry of a policy's metadata with the digest of its table."""
    return "table.sha256" if kind == 0 else f"table-{kind}.sha256"


class LoggedRun:
    """The metadata `trackmdp.run` of a log.

    Attributes:
        said: the metadata themselves.
        size: (rows, columns) of the grid.
        cells: M.
        sensors: S.
        modes: of the targets; 0 where they have none.
        t_max: T_max.
        kinds: of several targets, for each the number of its motion; empty in a log of one target.

    Raises:
        UserError: they are of another format, or describe no world; the message names `file`.
    """

    def __init__(self, file: Path, said: Mapping[str, str]) -> None:
        if (found := said.get("format_version")) != LOG_FORMAT:
            writer = said.get("trackmdp", "unknown")
            raise UserError(
                f"file={file}: format {found} (trackmdp {writer}), expected format {LOG_FORMAT}"
            )
        with decoded(f"file={file}", "a log of trackmdp"):
            self.said, rows = dict(said), int(said["size"])
            self.size = rows, int(said.get("columns", rows))
            self.cells = math.prod(self.size)
            self.sensors = int(said.get("sensors", self.cells))
            self.modes, self.t_max = int(said.get("modes", 0)), int(said["t_max"])
            self.kinds = tuple(map(int, said.get("targets", "").split()))
            if len(self.kinds) > MOST_TARGETS:
                raise ValueError("too many targets")

    def policy_tables(self, number: int, facts: Mapping[str, str]) -> dict[str, str]:
        """Name -> digest of the attachments with the tables of a policy; empty where it has none."""
        kinds = itertools.takewhile(lambda kind: facts.get(table_digest(kind)), itertools.count())
        return {policy_file(number, kind): facts[table_digest(kind)] for kind in kinds}

    @property
    def schemas(self) -> dict[str, tuple[str, dict[str, Any]]]:
        """Topic -> (name of its schema, JSON schema)."""
        if self.kinds:
            return schemas_of_several(len(self.kinds))
        modes = MODE if self.modes else {}
        return SCHEMAS | {topic: _with(topic, fields) for topic, fields in modes.items()}
