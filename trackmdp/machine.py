"""Memory and threads: the machine's free bytes, sizes as they are typed and printed, the threads of networks."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from trackmdp.errors import UserError

if TYPE_CHECKING:
    import torch

SIZE_PATTERN = r"[0-9]+(\.[0-9]+)?([KMGT]iB|B)?"
"""Sizes of memory as text: bytes, or with a unit of powers of 1,024."""

_UNITS = {"B": 0, "KiB": 1, "MiB": 2, "GiB": 3, "TiB": 4}
_LITTLE = 2**26
"""Bytes up to which the system is not asked: that takes a tenth of a millisecond."""
_CGROUPS = (
    ("memory.max", "memory.current", "inactive_file"),
    ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
)


def parse_bytes(text: str) -> int:
    """The bytes of a text of `SIZE_PATTERN`: 1.5GiB are 1.5 · 1,024³."""
    number = text.rstrip("KMGTiB")
    return int(float(number) * 1024 ** _UNITS[text[len(number) :] or "B"])


def gib(size: float) -> str:
    """A size as it is printed."""
    return f"{size / 2**30:,.2f} GiB"


def free_bytes(root: Path = Path("/")) -> int:
    """Bytes of memory still available under the system's and the job's own limit.

    A system without such a figure counts as unlimited. `root` is where its files are.
    """
    free = [_entry(root / "proc/meminfo", "MemAvailable:", 1024)]
    for limit, used, cache in _CGROUPS:
        for folder in (root / "sys/fs/cgroup", root / "sys/fs/cgroup/memory"):
            # A job's own limit (version 2 of cgroups, then version 1) may be far below the machine's free memory; the
            # kernel kills a process above it without a message. Pages of files that are not in use count as used, but
            # are given back.
            most, now = _number(folder / limit), _number(folder / used)
            if most is not None and now is not None:
                free.append(most - now + (_entry(folder / "memory.stat", cache, 1) or 0))
    return min((each for each in free if each is not None), default=2**63)


def check_free(what: str, needed: float) -> None:
    """See that so many bytes are free, before any of them is asked for.

    Without it a system that promises more than it has (Linux does) kills the process, or another one, and no message
    is left.

    Args:
        what: the option, for messages.
        needed: bytes, at the least.

    Raises:
        UserError: they are not.
    """
    if needed > _LITTLE and needed > (free := free_bytes()):
        raise UserError(f"{what}: needs about {gib(needed)}, {gib(free)} are available")


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Run networks with so many threads: networks of few rows wait long for more than one.

    The number is the whole process's; afterwards it is the former one again.
    """
    torch = sys.modules.get("torch")
    if torch is None:  # then there is no network either
        yield
        return
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _entry(file: Path, name: str, unit: int) -> int | None:
    """The number after `name` in a file of lines."""
    try:
        rows = (line.split() for line in file.read_text().splitlines())
        return next((int(row[1]) * unit for row in rows if row and row[0] == name), None)
    except OSError:
        return None


def _number(file: Path) -> int | None:
    try:
        text = file.read_text().strip()
    except OSError:
        return None
    # Version 2 writes `max` where there is no limit.
    return int(text) if text.isdigit() else None


def make_device(name: torch.device | str, key: str = "device") -> torch.device:
    """The torch device called `name`; `auto` is the first GPU where there is one.

    Raises:
        UserError: there is no such device here.
    """
    import torch

    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if name == "auto":
        return torch.device("cuda:0" if count else "cpu")
    try:
        device = torch.device(name)
        if device.type != "cuda":
            torch.empty(0, device=device)  # raises where there is none, as `mps` but on a Mac
            return device
        if (device.index or 0) < count:
            return device
    except (AssertionError, RuntimeError, TypeError):
        pass  # no name of a device, an index that is no C integer, or PyTorch was built without it
    raise UserError(
        f"{key}={name}: no such device here ({count} CUDA devices found); use cpu or auto"
    )
