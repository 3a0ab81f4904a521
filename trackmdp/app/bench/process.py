"""What is measured: rates of repeated work, and time and memory of a whole program from its start to its end."""

from __future__ import annotations

import csv
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
from hydra.core.hydra_config import HydraConfig

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
    """What a process took: seconds from its start to its end, CPU seconds, and its peak memory."""

    wall_seconds: float
    cpu_seconds: float
    peak_mib: float


def measured(*words: str, script: str | None = None, python: str = sys.executable, quiet: bool = False) -> Usage:
    """Run `trackmdp words...`, or `python script words...`, in a process of its own.

    Args:
        words: what is typed.
        script: a Python file; None for this package.
        python: the interpreter of `script`.
        quiet: throw away what it prints.

    Raises:
        CalledProcessError: it failed.
    """
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder, "usage.json")
        # As a user starts it, imports included, not by a call within this process, which has imported everything.
        program = ("module", "trackmdp.app.cli") if script is None else ("script", script)
        output = subprocess.DEVNULL if quiet else None
        started = time.perf_counter()
        subprocess.run([python, "-c", _WRAPPER, str(report), *program, *words], check=True, stdout=output)
        wall = time.perf_counter() - started
        return Usage(wall, **json.loads(report.read_text()))


def timed_training(*words: str) -> tuple[list[dict[str, str]], Usage]:
    """Run `trackmdp train words...` in a process of its own: the rows of `metrics.csv` with a regret, what it took."""
    with tempfile.TemporaryDirectory() as folder:
        usage = measured("train", *words, "quiet=true", f"hydra.run.dir={folder}/run")
        with Path(folder, "run", "metrics.csv").open() as stream:
            # Rows between two evaluations have no regret.
            return [row for row in csv.DictReader(stream) if row["regret_per_step"]], usage


def typed(*keys: str) -> list[str]:
    """The words typed for this benchmark that are about one of `keys`."""
    return [word for word in HydraConfig.get().overrides.task if word.lstrip("+").startswith(keys)]


@contextmanager
def on_one_core() -> Iterator[None]:
    """Meanwhile this process, and those it starts, run on one and the same core, where the system lets them."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    # Processes started inside inherit the choice. On one core they take turns, and none is timed on a faster or busier
    # one.
    cores: Sequence[int] = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {cores[-1]})
    try:
        yield
    finally:
        os.sched_setaffinity(0, cores)


def rate(work: Callable[[], int], seconds: float, device: torch.device) -> dict[str, float]:
    """Call `work` for at least `seconds` after a warm-up call; units per wall second and CPU microseconds per unit.

    The call is repeated in five blocks and the fastest counts: other load on the machine only ever slows a block down.
    """
    # The first call compiles, allocates and fills caches.
    work()
    best = {"per_second": 0.0, "cpu_us_each": float("inf")}
    for _ in range(5):
        done, cpu, wall = 0, time.process_time(), time.perf_counter()
        while time.perf_counter() - wall < seconds / 5:
            done += work()
            # Work on a GPU is only queued by the call; without waiting, the queue would be timed.
            if device.type == "cuda":
                torch.cuda.synchronize(device)
        spent, used = time.perf_counter() - wall, time.process_time() - cpu
        # Each by itself: the block with the best wall time need not be the one with the least CPU time.
        best["per_second"] = max(best["per_second"], done / spent)
        best["cpu_us_each"] = min(best["cpu_us_each"], 1e6 * used / done)
    return best
