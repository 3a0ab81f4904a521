"""What a log may say: the types and ranges that hold for every log this program writes, whoever wrote this one.

A checksum proves that a log is what was written, not that it makes sense. Whatever is read is held against these rules
before it is used as a size, an index or a count.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from trackmdp.episodes import schema

_MOST = 10**9
"""Steps, episodes, T_max: beyond any log, and small enough to be multiplied without overflow."""

_LARGEST_GRID = 1024
_FINITE = 1e30
"""A reward is stored as float32, whose largest number is 3.4e38; a sum of many must stay below it."""


def modes_of(run: Mapping[str, str]) -> int:
    """Modes of the targets of a log; 0 where they have none."""
    return int(run.get("modes") or 0)


def check_run(run: Mapping[str, str]) -> None:
    """See that the metadata `trackmdp.run` describe a world.

    Raises:
        ValueError: they do not.
    """
    _count(run, "size", 1, _LARGEST_GRID)
    # Of rectangles, of worlds with a window, and of targets with modes and detections that tell them.
    for name, least in {"columns": 1, "window": 0, "modes": 1, "revealed": 1}.items():
        if run.get(name):
            _count(run, name, least, _LARGEST_GRID)
    if run.get("sensors"):
        _count(run, "sensors", 1, _LARGEST_GRID**2)
    _count(run, "t_max", 0, _MOST)
    if run["max_steps"]:
        _count(run, "max_steps", 1, _MOST)
    for name in ("reward", "safe_cost"):
        if not abs(float(run[name])) < _FINITE:
            raise ValueError(f"{name} {run[name]}")
    if not run.get("trackmdp"):
        raise ValueError("no version of trackmdp")


def size_of_grid(run: Mapping[str, str]) -> tuple[int, int]:
    """(rows, columns) of a log's grid; `columns` is said of rectangles alone."""
    return int(run["size"]), int(run.get("columns") or run["size"])


def tables_of(run: Mapping[str, str]) -> tuple[str, ...]:
    """The attachments that a log's world and config are read from.

    `sensors.npy` only where sensors may miss, `footprints.npz` only where they cover several cells.
    """
    every = ("config.yaml", "kernel.npz" if "kernel.npz.sha256" in run else "kernel.npy", "cost.npy")
    return (*every, *(name for name in ("sensors.npy", "footprints.npz") if f"{name}.sha256" in run))


def sensors_of(run: Mapping[str, str]) -> int:
    """S, the sensors of a log's world; said of those with footprints alone, else there is one in each cell."""
    rows, columns = size_of_grid(run)
    return int(run.get("sensors") or rows * columns)


def policy_file(number: int, run: Mapping[str, str]) -> str:
    """The attachment with the table of a policy: a CSR matrix where the kernel is one."""
    return f"policy-{number}.{'npz' if 'kernel.npz.sha256' in run else 'npy'}"


def check_policy(facts: Mapping[str, str], sensors: int) -> None:
    """See that the metadata of a policy name its kind and its table.

    Raises:
        ValueError, KeyError: they do not.
    """
    if not re.fullmatch(r"([0-9a-f]{64})?", facts["table.sha256"]):
        raise ValueError("the digest of a policy's table")
    if facts["kind"] == "random_k":
        _count(facts, "k", 0, sensors)
    if "memory" in facts:
        _count(facts, "clip", 1, _LARGEST_GRID)
        _count(facts, "revealed", 1, _LARGEST_GRID)


def check_row(row: Any, cells: int, modes: int = 0) -> dict[str, Any]:
    """An entry of the index of episodes, or the `/episode` message, which is the same.

    Args:
        row: as it was decoded.
        cells: M.
        modes: of the targets, 0 where they have none.

    Raises:
        ValueError, KeyError, TypeError: it is something else.
    """
    whole = {"episode": _MOST, "policy": _MOST, "start": cells, "length": _MOST, "detections": _MOST, "forced": _MOST}
    whole |= {"start_mode": modes} if modes else {}
    for name, limit in whole.items():
        if type(row[name]) is not int or not 0 <= row[name] < limit:
            raise ValueError(f"{name} {str(row[name])[:40]} of an episode")
    if type(row["terminated"]) is not bool or type(row["truncated"]) is not bool:
        raise ValueError("how an episode ended")
    if not _is_number(row["return"]):
        raise ValueError("the return of an episode")
    _count(row, "seed", 0, 2**64)
    begin, end = (_count(row, name, schema.time_of(0), 2**63) for name in ("start_time", "end_time"))
    # The times are used to look up messages, the length to allocate: they must agree before either is.
    if row["length"] < 1 or end - begin != (row["length"] - 1) * schema.TICK_NS:
        raise ValueError("the times of an episode are not those of its steps")
    return dict(row)


def check_steps(steps: Sequence[Any], cells: int, modes: int = 0, sensors: int | None = None) -> None:
    """See that `/step` messages name cells, sensors and modes that there are, and finite rewards.

    `sensors` None stands for one in each cell.

    Raises:
        ValueError, KeyError, TypeError: one does not.
    """
    number = cells if sensors is None else sensors
    rules: dict[str, Callable[[Any], bool]] = {
        "n": lambda n: type(n) is int and 0 <= n < _MOST,
        "target": lambda cell: type(cell) is int and -1 <= cell < cells,
        "obs": lambda cell: type(cell) is int and -1 <= cell < cells,
        "reward": _is_number,
        "active": lambda on: type(on) is list and all(type(each) is int and 0 <= each < number for each in on),
    }
    if modes:
        rules["mode"] = lambda mode: type(mode) is int and -1 <= mode < modes
    for step in steps:
        for name, holds in rules.items():
            if not holds(step[name]):
                raise ValueError(f"{name} {str(step[name])[:40]} of a step")


def _count(said: Mapping[str, Any], name: str, least: int, most: int) -> int:
    """The decimal number that `said` has as text."""
    text = said[name]
    # int() would also take ' 5', '1_0' and the digits of other scripts.
    if not isinstance(text, str) or not re.fullmatch(r"[0-9]{1,20}", text) or not least <= int(text) <= most:
        raise ValueError(f"{name} {str(text)[:40]!r}, expected {least:,} to {most:,}")
    return int(text)


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and math.isfinite(value) and abs(value) < _FINITE
