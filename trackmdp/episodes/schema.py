"""What stands in a log: topics and their JSON schemas, the time line, sealed metadata, versions.

And what a log may say: the types and ranges that hold for every log this program writes, whoever wrote this one.

A checksum proves that a log is what was written, not that it makes sense. Whatever is read is held against these rules
before it is used as a size, an index or a count.
"""

from __future__ import annotations

import hashlib
import json
import math
import platform
import re
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from typing import Any

from trackmdp import __version__
from trackmdp.errors import UserError
from trackmdp.untrusted import decoded

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

_GRID, _ROWS = "foxglove.Grid", "; the first row is the lowest"
_TOPICS = {
    "/step": ("trackmdp.Step", "One step: what was known and chosen before the move, what came of it after"),
    "/grid": (
        "foxglove.Grid",
        f"belief and policy of every cell, of large grids of the part where they are not 0{_ROWS}",
    ),
    "/active": (_GRID, f"the cells sensed, in the smallest rectangle around them{_ROWS}"),
    "/target": (_GRID, f"the true cell of the target{_ROWS}"),
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
    apart = {name: here for name, here in versions().items() if logged.get(name) != here}
    return ", ".join(f"{name} {logged.get(name, 'unknown')} (here {here})" for name, here in apart.items())


_MOST = 10**9
"""Steps, episodes, T_max: beyond any log, and small enough to be multiplied without overflow."""

_LARGEST_GRID = 1024
_FINITE = 1e30
"""A reward is stored as float32, whose largest number is 3.4e38; a sum of many must stay below it."""


class LoggedRun:
    """The metadata `trackmdp.run` of a log, once they are seen to describe a world.

    Attributes:
        said: the metadata themselves.
        size: (rows, columns) of the grid; `columns` is said of rectangles alone.
        cells: M.
        sensors: S; said of those with footprints alone, else there is one in each cell.
        window: W; None for none.
        modes: of the targets; 0 where they have none.
        revealed: modes that a detection tells apart.
        t_max: T_max.
        max_steps: where episodes are truncated; None for never.
        reward: r.
        safe_cost: D.
        sparse: whether kernel and policies are written as CSR matrices.
        tables: the attachments that world and config are read from; `sensors.npy` is one where sensors may miss,
            `footprints.npz` where they cover several cells.

    Raises:
        ValueError, KeyError: they describe none.
    """

    def __init__(self, said: Mapping[str, str]) -> None:
        def known(name: str, least: int, most: int = _LARGEST_GRID) -> int | None:
            return _count(said, name, least, most) if said.get(name) else None

        self.said, rows = dict(said), _count(said, "size", 1, _LARGEST_GRID)
        self.size = (rows, known("columns", 1) or rows)
        self.cells = math.prod(self.size)
        self.sensors = known("sensors", 1, _LARGEST_GRID**2) or self.cells
        self.window, self.modes, self.revealed = known("window", 0), known("modes", 1) or 0, known("revealed", 1) or 1
        self.t_max = _count(said, "t_max", 0, _MOST)
        self.max_steps = _count(said, "max_steps", 1, _MOST) if said["max_steps"] else None
        self.reward, self.safe_cost = float(said["reward"]), float(said["safe_cost"])
        if not (abs(self.reward) < _FINITE and abs(self.safe_cost) < _FINITE and said.get("trackmdp")):
            raise ValueError("a reward or cost that is not finite, or no version of trackmdp")
        self.sparse = "kernel.npz.sha256" in said
        every = ("config.yaml", "kernel.npz" if self.sparse else "kernel.npy", "cost.npy")
        self.tables = (*every, *(name for name in ("sensors.npy", "footprints.npz") if f"{name}.sha256" in said))

    @classmethod
    def of(cls, file: Path, said: Mapping[str, str]) -> LoggedRun:
        """What the log `file` says.

        Raises:
            UserError: it is of another format, or describes no world.
        """
        if (found := said.get("format_version")) != LOG_FORMAT:
            writer = said.get("trackmdp", "unknown")
            raise UserError(f"file={file}: format {found} (trackmdp {writer}), expected format {LOG_FORMAT}")
        with decoded(f"file={file}", "a log of trackmdp"):
            return cls(said)

    def policy_file(self, number: int) -> str:
        """The attachment with the table of a policy."""
        return f"policy-{number}.{'npz' if self.sparse else 'npy'}"

    def check_policy(self, facts: Mapping[str, str]) -> None:
        """See that the metadata of a policy name its kind and its table.

        Raises:
            ValueError, KeyError: they do not.
        """
        if not re.fullmatch(r"([0-9a-f]{64})?", facts["table.sha256"]):
            raise ValueError("the digest of a policy's table")
        if facts["kind"] == "random_k":
            _count(facts, "k", 0, self.sensors)
        for name in ("clip", "revealed") if "memory" in facts else ():
            _count(facts, name, 1, _LARGEST_GRID)

    def checked_row(self, row: Any) -> dict[str, Any]:
        """An entry of the index of episodes, or the `/episode` message, which is the same.

        Raises:
            ValueError, KeyError, TypeError: it is something else.
        """
        whole = dict.fromkeys(("episode", "policy", "length", "detections", "forced"), range(_MOST))
        whole |= {"start": range(self.cells)} | ({"start_mode": range(self.modes)} if self.modes else {})
        _check_whole(row, whole, "an episode")
        if type(row["terminated"]) is not bool or type(row["truncated"]) is not bool:
            raise ValueError("how an episode ended")
        if not _is_number(row["return"]):
            raise ValueError("the return of an episode")
        _count(row, "seed", 0, 2**64)
        begin, end = (_count(row, name, time_of(0), 2**63) for name in ("start_time", "end_time"))
        # The times are used to look up messages, the length to allocate: they must agree before either is.
        if row["length"] < 1 or end - begin != (row["length"] - 1) * TICK_NS:
            raise ValueError("the times of an episode are not those of its steps")
        return dict(row)

    def check_steps(self, steps: Sequence[Any]) -> None:
        """See that `/step` messages name cells, sensors and modes that there are, and finite rewards.

        Raises:
            ValueError, KeyError, TypeError: one does not.
        """
        whole = {"n": range(_MOST)} | dict.fromkeys(("target", "obs"), range(-1, self.cells))
        whole |= {"mode": range(-1, self.modes)} if self.modes else {}
        for step in steps:
            _check_whole(step, whole, "a step")
            on, reward = step["active"], step["reward"]
            if type(on) is not list or not all(type(it) is int and 0 <= it < self.sensors for it in on):
                raise ValueError(f"active {str(on)[:40]} of a step")
            if not _is_number(reward):
                raise ValueError(f"reward {str(reward)[:40]} of a step")


def _check_whole(said: Mapping[str, Any], allowed: Mapping[str, range], of: str) -> None:
    """See that each of some entries is a whole number that is allowed."""
    for name, numbers in allowed.items():
        if type(said[name]) is not int or said[name] not in numbers:
            raise ValueError(f"{name} {str(said[name])[:40]} of {of}")


def _count(said: Mapping[str, Any], name: str, least: int, most: int) -> int:
    """The decimal number that `said` has as text."""
    text = said[name]
    # int() would also take ' 5', '1_0' and the digits of other scripts.
    if not isinstance(text, str) or not re.fullmatch(r"[0-9]{1,20}", text) or not least <= int(text) <= most:
        raise ValueError(f"{name} {str(text)[:40]!r}, expected {least:,} to {most:,}")
    return int(text)


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and math.isfinite(value) and abs(value) < _FINITE
