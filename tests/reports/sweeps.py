"""Sweeps as `train -m` leaves them, without learning: policies are the clocked one, some sensors switched over."""

from __future__ import annotations

import copy
import csv
import functools
from pathlib import Path
from typing import Any

import numpy as np

from tests.helpers import train_config
from trackmdp.config import TrainConfig
from trackmdp.config.sensors import PaperCostConfig
from trackmdp.config.tree import config_digest, config_text
from trackmdp.durable import write_json
from trackmdp.policies.policy import Policy
from trackmdp.solvers import rules
from trackmdp.solvers.evaluation import figures
from trackmdp.training.evaluator import ExactEvaluator
from trackmdp.training.folders import write_summary
from trackmdp.world.configured import build_world
from trackmdp.world.problem_file import PROBLEM, problem_bytes

VERSIONS = {"trackmdp": "0.1.0", "torch": "2.13.0"}
MACHINE = {"processor": "a processor", "cores": 2}


@functools.cache
def _composed(*overrides: str) -> TrainConfig:
    return train_config("quiet=true", *overrides)


def write_run(
    folder: Path,
    *overrides: str,
    cost: float = 0.16,
    seed: int = 0,
    wrong: int = 0,
    versions: dict[str, str] | None = None,
) -> dict[str, Any]:
    """A finished run with `wrong` sensors switched over; returns its summary."""
    folder.mkdir(parents=True)
    cfg = copy.deepcopy(_composed(*overrides))
    assert isinstance(cfg.cost, PaperCostConfig)
    cfg.cost.sensor, cfg.seed = cost, seed
    world = build_world(cfg)
    evaluator = ExactEvaluator(world)
    chains = rules.clocked_policy(world).dense()
    rng = np.random.default_rng(cfg.seed)
    chains.flat[rng.choice(chains.size, wrong, replace=False)] ^= True
    score = evaluator.score(Policy.from_dense(world, chains))
    summary = {
        "algo": cfg.algo.name,
        "seed": cfg.seed,
        "frames": 4000,
        "wall_seconds": 2.0,
        "cpu_seconds": 1.5,
        "policy": figures(score.evaluation),
        "qmdp": figures(evaluator.qmdp),
        "bounds": evaluator.bounds,
        "references": {"all on": figures(evaluator.evaluate(Policy.all_on(world)))},
        "optimal": {"lower": evaluator.upper - 0.01, "upper": evaluator.upper, "certified": True},
        "regret_per_step": score.regret_per_step,
        "versions": versions or VERSIONS,
        "machine": MACHINE,
        "config_sha256": config_digest(cfg, folder),
    }
    (folder / "config.yaml").write_text(config_text(cfg, folder), encoding="utf-8")
    (folder / PROBLEM).write_bytes(problem_bytes(world))
    Policy.from_dense(world, chains).save(folder / "policy.npz", score.evaluation.value)
    write_curve(folder, np.linspace(-100.0, score.evaluation.aihtr, 40))
    write_summary(folder, summary)
    return summary


def write_curve(folder: Path, aihtr: np.ndarray) -> None:
    """A `metrics.csv` that is judged at every second iteration."""
    with (folder / "metrics.csv").open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["iteration", "frames", "aihtr", "seconds"])
        for place, value in enumerate(aihtr, start=1):
            writer.writerow([2 * place - 1, 200 * place - 100, "", 0.1 * place - 0.05])
            writer.writerow([2 * place, 200 * place, value, 0.1 * place])


def write_sweep(folder: Path, *prices: float) -> Path:
    """Two prices or those given, two algorithms, three seeds, on a small grid."""
    for cost in prices or (0.16, 0.22):
        for algo, wrong in (("a2c", 9), ("hindsight", 1)):
            for seed in range(3):
                name = f"{algo}-{cost}-{seed}"
                write_run(
                    folder / name,
                    "grid.size=3",
                    f"algo={algo}",
                    cost=cost,
                    seed=seed,
                    wrong=wrong + seed,
                )
    return folder


def plan(folder: Path, *names: object) -> None:
    """Write the plan of a sweep with these runs."""
    jobs = [{"folder": name, "overrides": []} for name in names]
    line = "trackmdp train -m 'hydra.sweep.dir=/x y'"
    write_json(folder / "sweep.json", {"command": "train", "line": line, "jobs": jobs})
