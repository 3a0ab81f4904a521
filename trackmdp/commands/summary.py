"""What a training run says of itself at its end: `summary.json`, and a table at the terminal."""

from __future__ import annotations

import dataclasses
import hashlib
import platform
from importlib.metadata import version
from typing import Any

import numpy as np
from rich.console import Console

from trackmdp import __version__
from trackmdp.bench.machine import machine
from trackmdp.config import TrainConfig, to_yaml
from trackmdp.solvers.optimal import Solution
from trackmdp.training.display import table
from trackmdp.training.judge import Judge, Verdict, figures

__all__ = ["config_text", "digest", "show", "summarize"]

_PACKAGES = ("torch", "torchrl", "tensordict", "hydra-core", "numpy", "scipy")


def config_text(cfg: TrainConfig) -> str:
    """The text of `config.yaml`; how a run was gone on with is not part of it."""
    return to_yaml(dataclasses.replace(cfg, resume=None))


def digest(cfg: TrainConfig) -> str:
    """SHA-256 of `config.yaml`."""
    return hashlib.sha256(config_text(cfg).encode()).hexdigest()


def summarize(
    cfg: TrainConfig,
    judge: Judge,
    verdict: Verdict,
    solution: Solution | None,
    frames: int,
    times: dict[str, float],
) -> dict[str, Any]:
    """The content of `summary.json`."""
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
        | {name: version(name) for name in _PACKAGES},
        "machine": machine(),
        "config_sha256": digest(cfg),
    }


def show(console: Console, cfg: TrainConfig, judge: Judge, verdict: Verdict, solution: Solution | None) -> None:
    """The learned policy beside Q_MDP, all sensors on, and the optimum where it was solved for."""
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
