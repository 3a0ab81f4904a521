"""`evaluate` with false alarms: sensors report targets that are not there, and a policy believes each report."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from trackmdp.config import EvaluateConfig, FalseAlarmConfig
from trackmdp.config.registry import make
from trackmdp.durable import write_json
from trackmdp.episodes.filtered import simulate_filter
from trackmdp.policies.policy import Policy
from trackmdp.solvers import bounds
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.evaluation import figures
from trackmdp.training.display import FIGURES, table, with_interval
from trackmdp.world.model import World
from trackmdp.world.problem import Problem, modelled


def evaluate_believed(
    cfg: EvaluateConfig, problem: Problem, policy: Policy, subject: str, folder: Path, at: Console
) -> float:
    """Evaluate where sensors report targets that are not there: the exact AIHTR, each report taken for the truth.

    Raises:
        UserError: tracks instead of a world, or a refusal of `trackmdp.solvers.false_alarms.believed`.
    """
    sensor = cfg.sensor
    assert isinstance(sensor, FalseAlarmConfig)
    # A trained policy's world is its run's, with the sensors asked for.
    sensors = make(sensor, problem.size)
    world = modelled(problem, "sensor=false_alarm").but(safe_detection=1.0, **sensors)
    silent, alarmed = evaluate(world, policy), evaluate(world, policy, false_alarm=sensor.p_f)
    # A window is about the last located cell, and the filter is never sure of one.
    wanted = cfg.episodes if world.window is None else 0
    filtered = _filtered(world, sensor.p_f, wanted, cfg.seed, alarmed.expected_length)
    # Not the clocked bound: a report that is wrong sets the clock back, and D is paid later.
    bound = float(bounds.valid(world).mean())
    loss = (silent.aihtr - alarmed.aihtr) / alarmed.expected_length
    noisy, plain = figures(alarmed), figures(silent)
    report = {
        "policy": subject,
        "p_f": sensor.p_f,
        "exact": noisy,
        "without_false_alarms": plain,
        "filter": filtered if wanted else None,
        "bounds": {"valid": bound},
        "loss_per_step": loss,
    }
    write_json(folder / "evaluation.json", report)
    keys = ("aihtr", "accuracy", "sensors_per_step")
    columns = {"figure": [FIGURES[key] for key in keys]}
    for head, found in ((f"p_f = {sensor.p_f:g}, exact", noisy), ("p_f = 0", plain)):
        columns[head] = [f"{found[key]:,.4f}" for key in keys]
    if wanted:
        played = f"Bayes filter, {wanted} episodes, 95 %"
        columns[played] = [with_interval(filtered[key], 4) for key in keys]
    rows = [list(row) for row in zip(*columns.values(), strict=True)]
    at.print(table(f"{subject}, each report taken for the truth", list(columns), rows))
    lost = f"{loss:.4f} a step lost to false alarms"
    at.print(f"upper bound (valid, of p_f = 0) {bound:,.4f}; {lost}; results in {folder}")
    return alarmed.aihtr


def _filtered(
    world: World, p_f: float, episodes: int, seed: int, steps: float
) -> dict[str, dict[str, Any]]:
    """Figures of a tracker with the exact belief, with intervals; `steps` is the exact length of an episode."""
    simulated = simulate_filter(world, p_f, episodes, seed=seed).intervals(np.arange(episodes))
    found = {key: asdict(each) for key, each in simulated.items()}
    # The length of a stay is known exactly, and the same for all policies: most of the variance of returns.
    rate = found["reward_per_step"]
    found["aihtr"] |= {end: rate[end] and steps * rate[end] for end in ("mean", "low", "high")}
    return found
