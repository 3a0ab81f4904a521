"""Time and memory by the side of the grid: solving, training and stepping, each in a process of its own."""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path

from benchmarks import clock
from benchmarks.words import Row, as_words
from trackmdp.errors import UserError

COSTS = (0.16, 0.22)
"""Prices: at the first beliefs hardly spread, at the second all probabilities lie below c/r."""
WINDOW, ENVS = 2, 1024
_SCRIPT = Path(__file__).parents[1] / "benchmark.py"


def rows(
    words: Mapping[str, str],
    sizes: tuple[int, ...] = (10, 20, 40, 64, 128, 256),
    work: tuple[str, ...] = ("solve", "train", "env"),
    learner: str = "model_based",  # its default budget is 300 frames for each cell
    seconds: float = 2.0,
    seed: int = 0,
    threads: int = 1,
) -> Iterator[Row]:
    """One row for each size and kind of work, Python's start-up included.

    A row of `env` has the steps per second, and the memory of the process. A run that is refused, for example for
    lack of memory, has a row without figures. The exponents are of the growth of CPU time and of memory in M since the
    size before.
    """
    kept = {key: text for key, text in words.items() if key not in ("grid.size", "cost.sensor")}
    before: dict[str, Row] = {}
    for n in sizes:
        at = [*as_words(kept), f"grid.size={n}"]
        own = [f"threads={threads}", f"seed={seed}"]
        kinds: dict[str, tuple[str, ...]] = {}
        if "solve" in work:
            kinds |= {f"solve, c = {c:g}": ("solve", *at, f"cost.sensor={c}") for c in COSTS}
        if "train" in work:
            # Actions over all cells would make a budget per cell one of M² numbers.
            options = (f"algo={learner}", f"grid.window={WINDOW}")
            kinds[f"train {learner}, window {WINDOW}"] = ("train", *at, *own, *options)
        if "env" in work:
            steps = ("env", *at, *own, f"batch_sizes=[{ENVS}]", f"seconds={seconds}")
            kinds[f"env, B = {ENVS}"] = steps
            kinds[f"env, B = {ENVS}, window {WINDOW}"] = (*steps, f"grid.window={WINDOW}")
        for what, (kind, *typed) in kinds.items():
            row = {"N": n, "what": what, **_measured(kind, typed)}
            yield row | _growth(before.get(what), row)
            before[what] = row


def _measured(kind: str, words: list[str]) -> Row:
    """Seconds, peak memory, regret and rate of one process; None for what it does not have."""
    row: Row = dict.fromkeys(
        ("wall_seconds", "cpu_seconds", "peak_mib", "regret_per_step", "per_second")
    )
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder, "out.json")
        run = Path(folder, "run")
        try:
            if kind == "env":
                usage = clock.measured("part=env", *words, f"out={out}", script=str(_SCRIPT))
                result = json.loads(out.read_text())["rows"][0]
                return row | {"peak_mib": usage.peak_mib, "per_second": result["per_second"]}
            usage = clock.measured(kind, *words, "quiet=true", f"hydra.run.dir={run}")
        # A size that is refused is a result, and the larger sizes are still of interest.
        except UserError:
            return row
        name = "solution.json" if kind == "solve" else "summary.json"
        regret = json.loads((run / name).read_text())["regret_per_step"]
    return row | asdict(usage) | {"regret_per_step": regret}


def _growth(before: Row | None, row: Row) -> Row:
    """Exponents of CPU time and memory in M = N², from the row of the size before.

    Example: 16 s at N = 512 and 61 s at N = 1000 give log(61 / 16) / log(1000² / 512²) = 1.0.
    """
    found: Row = {}
    for name, key in (("cpu_exponent", "cpu_seconds"), ("memory_exponent", "peak_mib")):
        found[name] = None
        if before and before[key] and row[key] and before["N"] != row["N"]:
            found[name] = math.log(row[key] / before[key]) / (2 * math.log(row["N"] / before["N"]))
    return found
