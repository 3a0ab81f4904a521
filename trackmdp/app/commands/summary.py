"""What a training run says of itself at its end: `summary.json`, and a table at the terminal."""

from __future__ import annotations

import platform
from importlib.metadata import version
from typing import Any

import numpy as np
from rich.console import Console

from trackmdp import __version__
from trackmdp.app.bench.machine import machine
from trackmdp.config import TrainConfig
from trackmdp.config.resume import digest
from trackmdp.solvers.optimal import Solution
from trackmdp.training.display import table
from trackmdp.training.held_out import HeldOutJudge
from trackmdp.training.judge import Judge, Verdict, figures, while_collecting
from trackmdp.training.loop import Position

__all__ = ["show", "summarize"]

_PACKAGES = ("torch", "torchrl", "tensordict", "hydra-core", "numpy", "scipy")


def summarize(
    cfg: TrainConfig,
    judge: Judge | HeldOutJudge,
    verdict: Verdict,
    solution: Solution | None,
    end: Position,
    times: dict[str, float],
    held_out: dict[str, Any] | None,
) -> dict[str, Any]:
    """The content of `summary.json`; on held-out tracks there are no bounds, no Q_MDP and no regret."""
    return {
        "algo": cfg.algo.name,
        "credit": cfg.algo.credit,
        "seed": cfg.seed,
        "frames": end.frames,
        **times,
        "policy": figures(verdict.evaluation),
        "qmdp": figures(judge.qmdp) if isinstance(judge, Judge) else None,
        "bounds": judge.bounds if isinstance(judge, Judge) else dict.fromkeys(("paper", "valid", "clocked")),
        "optimal": {"lower": solution.lower, "upper": solution.upper, "certified": solution.certified}
        if solution
        else None,
        "regret_per_step": verdict.regret_per_step,
        "while_collecting": while_collecting(judge.upper, verdict.evaluation, end.reward, end.frames),
        "held_out": held_out,
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
