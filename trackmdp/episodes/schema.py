"""Format of a log: topics and their JSON schemas, the time line, sealed metadata, versions."""

from __future__ import annotations

import hashlib
import io
import itertools
import json
import platform
from collections.abc import Mapping
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from typing import Any

from trackmdp import __version__
from trackmdp.errors import UserError
from trackmdp.world.group import Subject
from trackmdp.world.problem_file import PROBLEM, subject_in

LOG_FORMAT = "7"
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


_LISTED = json.loads(
    files("trackmdp.episodes").joinpath("schemas.json").read_text(encoding="utf-8")
)
"""Topics of a log of one target and of several -> name and title of their schema; name -> its properties, as ordered in
messages. They are within the subset that viewers read: no null, no array of arrays.

Cells are numbered row by row from the top left; -1 stands for no cell: a target that exited, nothing observed.
"""
_BELIEF = "/belief/{}"


def belief_topic(target: int) -> str:
    """The topic of where one of several targets is expected."""
    return _BELIEF.format(target)


def schemas_of(problem: Subject) -> dict[str, tuple[str, dict[str, Any]]]:
    """Topic -> (name of its schema, JSON schema) of a log of `problem`."""
    targets, found = problem.targets, {}
    for topic, (name, title) in _LISTED["topics"]["several" if targets else "one"].items():
        properties = _LISTED["properties"][name]
        if modes_of(problem) > 1:
            properties = properties | _LISTED["properties"].get(f"{name} with modes", {})
        said = {"title": title, "type": "object", "properties": properties}
        for target in range(len(targets) if topic == _BELIEF else 1):
            found[topic.format(target)] = name, said
    return found


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


def policy_tables(number: int, facts: Mapping[str, str]) -> dict[str, str]:
    """Name -> digest of the attachments with the tables of a policy; empty where it has none."""
    kinds = itertools.takewhile(lambda kind: facts.get(table_digest(kind)), itertools.count())
    return {policy_file(number, kind): facts[table_digest(kind)] for kind in kinds}


def modes_of(problem: Subject) -> int:
    """H; 1 where targets have no modes."""
    return getattr(problem, "modes", 1)


def shape_of(problem: Subject) -> dict[str, str]:
    """The entries of `trackmdp.run` on the grid, the targets and T_max, for readers without this package."""
    task, modes = problem.single, modes_of(problem)
    return {
        "size": str(task.rows),
        **({} if task.rows == task.columns else {"columns": str(task.columns)}),
        **({} if task.coverage is None else {"sensors": str(task.total_sensors)}),
        **({} if modes == 1 else {"modes": str(modes)}),
        **({"targets": " ".join(map(str, problem.targets))} if problem.targets else {}),
        "t_max": str(task.t_max),
    }


def check_format(file: Path, said: Mapping[str, str]) -> None:
    """Check the format in the metadata `trackmdp.run` of a log.

    Raises:
        UserError: it is another one.
    """
    if (found := said.get("format_version")) != LOG_FORMAT:
        writer = said.get("trackmdp", "unknown")
        raise UserError(
            f"file={file}: format {found} (trackmdp {writer}), expected format {LOG_FORMAT}"
        )


def logged_problem(said: Mapping[str, str], content: bytes) -> Subject:
    """The problem in a log's `problem.npz`; call it inside `untrusted.decoded`.

    Raises:
        ValueError: the metadata `trackmdp.run` are of another problem.
    """
    problem = subject_in(io.BytesIO(content))
    if not shape_of(problem).items() <= said.items():
        raise ValueError(f"metadata {RUN} of another {PROBLEM}")
    return problem
