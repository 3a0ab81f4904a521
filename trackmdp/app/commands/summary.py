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
from trackmdp.training.evaluator import Evaluator, ExactEvaluator, Score, figures, while_collecting
from trackmdp.training.loop import Position

__all__ = ["show", "summarize"]

_PACKAGES = ("torch", "torchrl", "tensordict", "hydra-core", "numpy", "scipy")


def summarize(
    cfg: TrainConfig,
    evaluator: Evaluator,
    score: Score,
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
        "policy": figures(score.evaluation),
        "qmdp": figures(evaluator.qmdp) if evaluator.qmdp else None,
        "bounds": evaluator.bounds,
        "optimal": {"lower": solution.lower, "upper": solution.upper, "certified": solution.certified}
        if solution
        else None,
        "regret_per_step": score.regret_per_step,
        "while_collecting": while_collecting(evaluator.upper, score.evaluation, end.reward, end.frames),
        "held_out": held_out,
        "versions": {"trackmdp": __version__, "python": platform.python_version()}
        | {name: version(name) for name in _PACKAGES},
        "machine": machine(),
        "config_sha256": digest(cfg),
    }


def show(
    console: Console, cfg: TrainConfig, evaluator: ExactEvaluator, score: Score, solution: Solution | None
) -> None:
    """The learned policy beside Q_MDP, all sensors on, and the optimum where it was solved for."""
    shape = (evaluator.world.num_cells, evaluator.world.num_choices, evaluator.world.num_cells)
    policies = {
        f"learned ({cfg.algo.name})": score.evaluation,
        "Q_MDP": evaluator.qmdp,
        "all on": evaluator.evaluate(np.ones(shape, dtype=bool)),
    }
    if solution is not None:
        policies["optimum" if solution.certified else "best known"] = evaluator.evaluate(solution.chains)
    rows = [
        [name, f"{e.aihtr:,.3f}", f"{100 * e.accuracy:.2f} %", f"{e.sensors_per_step:.2f}"]
        for name, e in policies.items()
    ]
    rows.append(["upper bound", f"{evaluator.upper:,.3f}", "", ""])
    console.print(table("exact values", ["policy", "AIHTR", "accuracy", "sensors per step"], rows))
    regret = round(score.regret_per_step, 4) + 0.0
    console.print(f"regret per step {regret:.4f} to the upper bound")
