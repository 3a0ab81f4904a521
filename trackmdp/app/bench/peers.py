"""Beside ours what a user would pick instead: training scripts of others, on the same instance and the same core."""

from __future__ import annotations

import json
import math
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from trackmdp.app.bench.process import measured, on_one_core, trained
from trackmdp.config import BenchmarkConfig, PaperCostConfig, RandomSupportConfig
from trackmdp.errors import UserError
from trackmdp.world.model import World

__all__ = ["chart", "peers"]

GOAL = 0.02
"""Regret per step at which a peer's run ends."""
BUDGET = 300
"""Seconds after which it ends anyway."""


@dataclass(frozen=True)
class Instance:
    """Of the paper's worlds the one that all learn in."""

    support_size: int
    cost: float
    t_max: int


@dataclass(frozen=True)
class Run:
    """One learner's way to the goal, by the time of its whole process: imports and compilation count."""

    learner: str
    seed: int
    regret: float
    wall_seconds: float | None
    cpu_seconds: float | None
    frames: int | None
    peak_mib: float
    curve: list[tuple[float, float]]


def peers(cfg: BenchmarkConfig, world: World, device: torch.device) -> list[dict[str, Any]]:  # noqa: ARG001
    """One row per seed and learner; ours and the peers' take turns on one core.

    The seconds run from the start of the process until the regret per step was `GOAL` or less: of ours until it
    stayed there, of a peer's until it was there once. Everything else that the process did counts in full.

    A peer is a script `<name>_peer.py` in the folder `peers`. It takes `--algo ppo`, the instance (`--z --c --t-max`),
    `--seed`, `--stop-regret`, `--budget-seconds`, `--threads` and `--json FILE`, and writes `final_regret` and `curve`:
    rows of `seconds`, `steps`, `regret_per_step`.

    Raises:
        UserError: `peers` is no folder with such scripts, or the world is not one they know.
    """
    scripts = _scripts(cfg)
    instance = _instance(cfg)
    runs = []
    with on_one_core():
        for seed in cfg.seeds:
            runs.append(_ours(cfg, instance, seed, device))
            runs += [_peer(script, python, instance, seed, cfg.threads) for script, python in scripts]
    return [_row(run, _first(runs, run.seed)) for run in runs]


def _scripts(cfg: BenchmarkConfig) -> list[tuple[Path, str]]:
    if cfg.peers is None:
        raise UserError("peers=null: part=peers needs the folder with the peers' scripts")
    scripts = sorted(Path(cfg.peers).glob("*_peer.py"))
    if not scripts:
        raise UserError(f"peers={cfg.peers}: expected a folder with scripts called <name>_peer.py")
    pythons = cfg.peers_python or [sys.executable] * len(scripts)
    if len(pythons) != len(scripts):
        names = ", ".join(script.name for script in scripts)
        raise UserError(f"peers_python: {len(pythons)} interpreters, expected {len(scripts)} (for {names})")
    for python in pythons:
        if not Path(python).is_file():
            raise UserError(f"peers_python={python}: no such file, expected a Python interpreter")
    return list(zip(scripts, pythons, strict=True))


def _instance(cfg: BenchmarkConfig) -> Instance:
    kernel, cost = cfg.kernel, cfg.cost
    z = kernel.support_size if isinstance(kernel, RandomSupportConfig) and kernel.seed == kernel.support_size else None
    if z is None or not isinstance(cost, PaperCostConfig) or cfg.grid.size != 10:
        raise UserError("part=peers: the peers know the default kernel on a 10x10 grid with one price for all sensors")
    return Instance(z, cost.sensor, cfg.grid.t_max)


def _ours(cfg: BenchmarkConfig, at: Instance, seed: int, device: torch.device) -> Run:
    world = [f"kernel.support_size={at.support_size}", f"cost.sensor={at.cost}", f"grid.t_max={at.t_max}"]
    run = trained(*world, f"seed={seed}", f"threads={cfg.threads}", f"device={device}", "evaluation.every=1")
    reached, curve, usage = run.settled(GOAL), run.curve, run.usage
    # What came after the goal is known; all else, before the loop and after it, counts.
    end = float(curve[-1]["seconds"])
    early = None if reached is None else end - reached
    frames = next((int(row["frames"]) for row in curve if float(row["seconds"]) == reached), None)
    start = usage.wall_seconds - end
    return Run(
        "trackmdp hindsight",
        seed,
        run.summary["regret_per_step"],
        None if early is None else usage.wall_seconds - early,
        None if early is None else usage.cpu_seconds * (1 - early / usage.wall_seconds),
        frames,
        usage.peak_mib,
        [(start + float(row["seconds"]), float(row["regret_per_step"])) for row in curve],
    )


def _peer(script: Path, python: str, at: Instance, seed: int, threads: int) -> Run:
    with tempfile.TemporaryDirectory() as folder:
        file = f"{folder}/peer.json"
        limits = ["--stop-regret", str(GOAL), "--budget-seconds", str(BUDGET), "--threads", str(threads)]
        world = ["--z", str(at.support_size), "--c", str(at.cost), "--t-max", str(at.t_max)]
        words = ["--algo", "ppo", *world, "--seed", str(seed), *limits, "--json", file]
        usage = measured(*words, script=str(script), python=python, quiet=True)
        result = json.loads(Path(file).read_text())
    reached, curve = result["final_regret"] <= GOAL, result["curve"]
    start = usage.wall_seconds - curve[-1]["seconds"]
    return Run(
        f"{script.stem.removesuffix('_peer')} ppo",
        seed,
        result["final_regret"],
        usage.wall_seconds if reached else None,
        usage.cpu_seconds if reached else None,
        curve[-1]["steps"] if reached else None,
        usage.peak_mib,
        [(start + row["seconds"], row["regret_per_step"]) for row in curve],
    )


def _first(runs: list[Run], seed: int) -> Run:
    """Ours of the same seed."""
    return next(run for run in runs if run.seed == seed)


def _row(run: Run, ours: Run) -> dict[str, Any]:
    def times(mine: float | None, other: float | None) -> float | None:
        return None if mine is None or other is None else other / mine

    return {
        "part": "peers",
        "learner": run.learner,
        "seed": run.seed,
        "goal": GOAL,
        "frames": run.frames,
        "wall_seconds": run.wall_seconds,
        "cpu_seconds": run.cpu_seconds,
        "times_our_wall": times(ours.wall_seconds, run.wall_seconds),
        "times_our_cpu": times(ours.cpu_seconds, run.cpu_seconds),
        "last_regret": run.regret,
        "peak_mib": run.peak_mib,
        "curve": {"seconds": [at for at, _ in run.curve], "regret": [regret for _, regret in run.curve]},
    }


_WIDTH, _HEIGHT, _LEVELS = 72, 13, (10.0, 1.0, 0.1, 0.01, 0.001, 0.0001)


def chart(rows: list[dict[str, Any]], seed: int) -> str:
    """Regret per step against seconds since pressing Enter, both drawn with characters; one letter per learner."""
    shown = [row for row in rows if row["seed"] == seed]
    end = max(row["curve"]["seconds"][-1] for row in shown)
    lines = [[" "] * _WIDTH for _ in range(_HEIGHT)]
    for row in shown:
        for at, regret in zip(row["curve"]["seconds"], row["curve"]["regret"], strict=True):
            lines[_line(regret)][min(int(at / end * _WIDTH), _WIDTH - 1)] = row["learner"].split()[0][0]
    labels = {_line(level): f"{level:g}" for level in _LEVELS}
    drawn = [f"{labels.get(line, ''):>7} |{''.join(text).rstrip()}" for line, text in enumerate(lines)]
    legend = ", ".join(f"{row['learner'].split()[0][0]} {row['learner']}" for row in shown)
    axis = f"{'':>7} +{'-' * _WIDTH}\n{'':>8}0{f'{end:.0f} s':>{_WIDTH}}"
    return "\n".join(
        [*drawn, axis, f"{'':>8}regret per step against seconds from pressing Enter, seed {seed}: {legend}"]
    )


def _line(regret: float) -> int:
    """The line of a regret: logarithmic from the first of `_LEVELS`, at the top, to the last."""
    top, bottom = math.log10(_LEVELS[0]), math.log10(_LEVELS[-1])
    share = (top - math.log10(max(regret, _LEVELS[-1]))) / (top - bottom)
    return min(max(round(share * (_HEIGHT - 1)), 0), _HEIGHT - 1)
