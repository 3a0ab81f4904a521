"""`train`: learn a policy without the motion model, and judge it exactly."""

from __future__ import annotations

import hashlib
import io
import platform
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console

from trackmdp import __version__
from trackmdp.build import make_algorithm, make_collector, make_device, make_world
from trackmdp.config import TrainConfig, to_yaml
from trackmdp.seeding import seed_global
from trackmdp.solvers import optimal
from trackmdp.solvers.optimal import Solution
from trackmdp.training import checkpoint
from trackmdp.training.display import Display, make_console, table
from trackmdp.training.judge import Judge, Verdict, figures
from trackmdp.training.loop import Intervals, train
from trackmdp.training.metrics import MetricsLog, write_json, write_text
from trackmdp.world.model import World

__all__ = ["run"]


def run(cfg: TrainConfig, folder: Path) -> float:
    """Train as `cfg` says and write config, kernel, metrics, checkpoints and summary to `folder`; returns the AIHTR."""
    started, used = time.time(), time.process_time()
    console = make_console(cfg.quiet)
    torch.set_num_threads(cfg.threads)
    device = make_device(cfg.device)
    world = make_world(cfg)
    _write_inputs(cfg, world, folder)
    seed_global(cfg.seed)
    algorithm = make_algorithm(cfg, world, device)
    collector = make_collector(cfg, world, algorithm, device)
    judge = Judge(world, cfg.grid.max_steps)
    metrics = MetricsLog(folder, tensorboard=cfg.log.name == "tensorboard")
    every = Intervals(cfg.evaluation.every, cfg.log.every, cfg.checkpoint.every)
    digest = config_digest(cfg)

    def save(iteration: int, frames: int) -> None:
        state = {"algorithm": algorithm.state_dict(), "frames": frames, "config_sha256": digest}
        checkpoint.save(folder / "checkpoints", iteration, state, keep=cfg.checkpoint.keep)

    try:
        with Display(console, f"{cfg.algo.name} seed {cfg.seed}", algorithm.iterations) as display:
            verdict, frames = train(algorithm, collector, judge, metrics, display, every, save)
    finally:
        collector.shutdown()
        metrics.close()
    solution = _solve(cfg, world, console)
    if solution is not None:
        verdict = judge.tighten(solution.upper, verdict)
    times = {"wall_seconds": time.time() - started, "cpu_seconds": time.process_time() - used}
    summary = _summary(cfg, judge, verdict, solution, frames, times, digest)
    write_json(folder / "summary.json", summary)
    _show(console, cfg, judge, verdict, solution)
    console.print(f"{times['wall_seconds']:.1f} s; results in {folder}")
    return verdict.evaluation.aihtr


def _solve(cfg: TrainConfig, world: World, console: Console) -> Solution | None:
    """The certified optimum, where it is asked for; there is none for episodes cut by `grid.max_steps`."""
    if not cfg.optimal.enabled or cfg.grid.max_steps is not None:
        return None
    with console.status(f"solving for the optimum, at most {cfg.optimal.time_limit:g} s"):
        return optimal.solve(world, time_limit=cfg.optimal.time_limit)


def config_digest(cfg: TrainConfig) -> str:
    """SHA-256 of the resolved config, output options aside."""
    return hashlib.sha256(to_yaml(cfg).encode()).hexdigest()


def _write_inputs(cfg: TrainConfig, world: World, folder: Path) -> None:
    """`config.yaml` and `kernel.npy`: all that it takes to do the run again."""
    write_text(folder / "config.yaml", to_yaml(cfg))
    buffer = io.BytesIO()
    np.save(buffer, world.kernel)
    part = folder / "kernel.npy.part"
    part.write_bytes(buffer.getvalue())
    part.replace(folder / "kernel.npy")


def _summary(
    cfg: TrainConfig,
    judge: Judge,
    verdict: Verdict,
    solution: Solution | None,
    frames: int,
    times: dict[str, float],
    digest: str,
) -> dict[str, Any]:
    packages = ("torch", "torchrl", "tensordict", "hydra-core", "numpy", "scipy")
    return {
        "algo": cfg.algo.name,
        "seed": cfg.seed,
        "frames": frames,
        **times,
        "policy": figures(verdict.evaluation),
        "qmdp": figures(judge.qmdp),
        "bounds": judge.bounds,
        "optimal": {"lower": solution.lower, "upper": solution.upper, "certified": solution.certified}
        if solution
        else None,
        "regret_per_step": verdict.regret_per_step,
        "versions": {"trackmdp": __version__, "python": platform.python_version()}
        | {name: version(name) for name in packages},
        "config_sha256": digest,
    }


def _show(console: Console, cfg: TrainConfig, judge: Judge, verdict: Verdict, solution: Solution | None) -> None:
    shape = (judge.world.num_cells, judge.world.num_choices, judge.world.num_cells)
    policies = {
        f"learned ({cfg.algo.name})": verdict.evaluation,
        "Q_MDP": judge.qmdp,
        "all on": judge.evaluate(np.ones(shape, dtype=bool)),
    }
    if solution is not None:
        policies["optimum" if solution.certified else "best known"] = judge.evaluate(solution.chains)
    rows = [
        [name, f"{e.aihtr:,.3f}", f"{100 * e.accuracy:.2f} %", f"{e.sensors_per_step:.2f}"]
        for name, e in policies.items()
    ]
    rows.append(["upper bound", f"{judge.upper:,.3f}", "", ""])
    console.print(table("exact values", ["policy", "AIHTR", "accuracy", "sensors per step"], rows))
    regret = round(verdict.regret_per_step, 4) + 0.0
    console.print(f"regret per step {regret:.4f} to the upper bound")
