"""Evaluation of a policy where sensors report targets that are not there: its file and its table at the terminal."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np
from rich.console import Console

from trackmdp.app.commands.held_out import with_interval
from trackmdp.config import EvaluateConfig, FalseAlarmConfig
from trackmdp.durable import write_json
from trackmdp.episodes.filtered import simulate_filter
from trackmdp.errors import UserError
from trackmdp.policies.policy import Policy
from trackmdp.solvers import bounds
from trackmdp.solvers.evaluate import evaluate
from trackmdp.training.display import table
from trackmdp.training.evaluator import figures
from trackmdp.world.model import World
from trackmdp.world.sensors import false_alarm
from trackmdp.world.tracks import Problem

FIGURES = {
    "aihtr": "AIHTR",
    "accuracy": "accuracy",
    "sensors_per_step": "sensors per step",
    "safe_per_episode": "safe actions per episode",
    "expected_length": "steps per episode",
}
"""Figures of a policy as tables at the terminal have them."""


def run(cfg: EvaluateConfig, problem: Problem, policy: Policy, subject: str, folder: Path, console: Console) -> float:
    """Write `evaluation.json` to `folder`; returns the exact AIHTR with the false alarms, each report believed.

    Raises:
        UserError: tracks instead of a world, or what `trackmdp.solvers.alarms.believed` refuses.
    """
    sensor = cfg.sensor
    assert isinstance(sensor, FalseAlarmConfig)
    if not isinstance(problem, World):
        raise UserError("sensor=false_alarm: needs a motion model of cells alone, without modes; not recorded tracks")
    # A trained policy's world is that of its run, with the sensors asked for.
    world = World.of(
        problem, problem.kernel, safe_detection=1.0, **false_alarm(problem.size, p_d=sensor.p_d, p_f=sensor.p_f)
    )
    silent, alarmed = evaluate(world, policy), evaluate(world, policy, false_alarm=sensor.p_f)
    # A window is about the last located cell, and the filter is never sure of one.
    wanted = cfg.episodes if world.window is None else 0
    simulated = simulate_filter(world, sensor.p_f, wanted, seed=cfg.seed).intervals(np.arange(wanted))
    filtered = {key: asdict(each) for key, each in simulated.items()}
    # How long a target stays is known exactly, and whatever is sensed the same: most of what returns vary by.
    steps, rate = alarmed.expected_length, filtered["reward_per_step"]
    filtered["aihtr"] |= {end: rate[end] and steps * rate[end] for end in ("mean", "low", "high")}
    # Not the clocked bound: a report that is wrong sets the clock back, and D is paid later.
    bound = float(bounds.valid(world).mean())
    loss = (silent.aihtr - alarmed.aihtr) / alarmed.expected_length
    told, plain = figures(alarmed), figures(silent)
    report = {
        "policy": subject,
        "p_f": sensor.p_f,
        "exact": told,
        "without_false_alarms": plain,
        "filter": filtered if wanted else None,
        "bounds": {"valid": bound},
        "loss_per_step": loss,
    }
    write_json(folder / "evaluation.json", report)
    rows = []
    for key in ("aihtr", "accuracy", "sensors_per_step"):
        played = with_interval(filtered[key], 4) if wanted else ""
        rows.append([FIGURES[key], f"{told[key]:,.4f}", f"{plain[key]:,.4f}", played])
    heads = ["figure", f"p_f = {sensor.p_f:g}, exact", "p_f = 0", f"Bayes filter, {wanted} episodes, 95 %"]
    console.print(table(f"{subject}, each report taken for the truth", heads, rows))
    console.print(
        f"upper bound (valid, of p_f = 0) {bound:,.4f}; {loss:.4f} a step lost to false alarms; results in {folder}"
    )
    return alarmed.aihtr
