"""Clocks: rates of repeated work, and time and memory of a program from its start to its end."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import torch

from trackmdp.errors import UserError

HERE = str(Path(__file__).parents[2])
"""The checkout of the benchmarks."""

# Runs in the child, around the program: only a process itself can read its own peak memory when it ends.
_WRAPPER = """
import json, re, resource, runpy, sys
from pathlib import Path
report, kind, sys.argv = sys.argv[1], sys.argv[2], sys.argv[3:]
try:
    if kind == "module":
        runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
    else:
        sys.path[0] = str(Path(sys.argv[0]).parent)
        runpy.run_path(sys.argv[0], run_name="__main__")
finally:
    usage = resource.getrusage(resource.RUSAGE_SELF)
    own = Path("/proc/self/status")  # ru_maxrss starts at the peak of the process that started this one
    peak = int(re.search(r"VmHWM:\\s+(\\d+)", own.read_text())[1]) if own.is_file() else usage.ru_maxrss
    used = {"cpu_seconds": usage.ru_utime + usage.ru_stime, "peak_mib": peak / 1024}
    Path(report).write_text(json.dumps(used))
"""


@dataclass(frozen=True)
class Usage:
    """Wall seconds of a process from its start to its end, its CPU seconds, and its peak memory in MiB."""

    wall_seconds: float
    cpu_seconds: float
    peak_mib: float


def measured(
    *words: str,
    script: str | None = None,
    python: str = sys.executable,
    place: str = "",
    fails: bool = False,
) -> Usage:
    """Run `trackmdp words...`, or `python script words...`, in a process of its own, its output thrown away.

    Args:
        words: the command line.
        script: a Python file; None for trackmdp.
        python: the interpreter.
        place: checkout of the package; empty for the one that is imported here.
        fails: the process is meant to fail.

    Raises:
        UserError: the process failed; it has said why on stderr.
    """
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder, "usage.json")
        # A process as a user starts it, imports included; this process has imported everything already.
        program = ("module", "trackmdp.app.cli") if script is None else ("script", script)
        # `python -c` would put the current folder before the checkout.
        chosen = {"PYTHONPATH": place, "PYTHONSAFEPATH": "1"} if place else {}
        started = time.perf_counter()
        ended = subprocess.run(
            [python, "-c", _WRAPPER, str(report), *program, *words],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL if fails else None,
            env={**os.environ, **chosen},
        )
        wall = time.perf_counter() - started
        if ended.returncode and not fails:
            named = " ".join([script or "trackmdp", *words])
            raise UserError(f"{named}: status {ended.returncode}, expected 0; the reason is above")
        return Usage(wall, **json.loads(report.read_text()))


def checkout(place: str) -> str:
    """The folder `place`, which has a package.

    Raises:
        UserError: it has none.
    """
    if not Path(place, "trackmdp").is_dir():
        raise UserError(f"beside={place}: expected a folder with the package trackmdp")
    return place


def beside_checkout(place: str, typed: Sequence[str], key: str, repeat: int) -> tuple[float, float]:
    """The least `key` of the only row of `benchmark.py typed...`, with the package here and with that of `place`.

    Each turn is a process of its own, so that neither has caches or memory of the other.

    Raises:
        UserError: the checkout has no package.
    """
    found: dict[str, list[float]] = {HERE: [], checkout(place): []}
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder, "out.json")
        program = [sys.executable, str(Path(HERE, "scripts/benchmark.py")), *typed, f"out={out}"]
        for _ in range(repeat):
            for each, figures in found.items():
                # The scripts are named: under PYTHONSAFEPATH their own folder is not searched.
                own = {
                    **os.environ,
                    "PYTHONPATH": os.pathsep.join([each, str(Path(HERE, "scripts"))]),
                }
                subprocess.run(program, check=True, stdout=subprocess.DEVNULL, env=own)
                figures.append(json.loads(out.read_text())["rows"][0][key])
    return min(found[HERE]), min(found[place])


@contextmanager
def on_one_core() -> Iterator[None]:
    """Bind this process and the processes it starts to one core, where the system allows it."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    # Child processes inherit the choice. On one core they take turns, and none gets a faster or idler core.
    cores = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {cores[-1]})
    try:
        yield
    finally:
        os.sched_setaffinity(0, cores)


def rate(work: Callable[[], int], seconds: float, device: str = "cpu") -> dict[str, float]:
    """Call `work`, which returns the units done, for `seconds`: units per wall second, CPU microseconds per unit.

    After a warm-up call the time is split into five blocks and the fastest block counts: other load on the machine
    only ever slows a block down.
    """
    work()  # compiles, allocates and fills caches
    best = {"per_second": 0.0, "cpu_us_each": float("inf")}
    for _ in range(5):
        done = 0
        cpu, wall = time.process_time(), time.perf_counter()
        while time.perf_counter() - wall < seconds / 5:
            done += work()
            # Work on a GPU is only queued by the call; without waiting, the queue would be timed.
            if device.startswith("cuda"):
                torch.cuda.synchronize(device)
        spent, used = time.perf_counter() - wall, time.process_time() - cpu
        # Each by itself: the block with the best wall time need not be the one with the least CPU time.
        best["per_second"] = max(best["per_second"], done / spent)
        best["cpu_us_each"] = min(best["cpu_us_each"], 1e6 * used / done)
    return best
