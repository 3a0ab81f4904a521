"""Notices about a run: why its learner was chosen, and whether its policy is poor."""

from __future__ import annotations

import math
from collections.abc import Mapping

from trackmdp.config import TrainConfig
from trackmdp.sensing.task import Task
from trackmdp.world.group import Subject

FAR, _NEAR = 0.05, 0.01
"""Regret per step, in rewards of a detection, from which a policy counts as poor; of credit per sensor where more than
the cell counts."""
_SINGLE = "credit per sensor may miss sets that only pay together where more than the cell counts"
_INFERRED = "with a budget most cells of the paths are inferred, which blurs what hides in them"


def why_chosen(config: TrainConfig, subject: Subject) -> str | None:
    """The estimate that `model_based`, the default, makes of this problem, and the reason; None of other learners."""
    if config.algo.name != "model_based":
        return None
    recorded, task = subject.recorded is not None, subject.task
    estimate = getattr(config.algo, "estimate", None) or ("moves" if task.markov else "paths")
    if not task.markov:
        cause = "recorded tracks" if recorded else "hidden modes"
        why = f"{cause}, so that the next move may depend on more than the cell"
    elif recorded:
        why = "kernel.markov=true"
    else:
        why = "the next move depends on the last detection alone"
    plans = {"moves": "pooled moves", "paths": "whole paths, chosen on validation paths"}
    return f"algo=model_based: plans on {plans[estimate]} ({why})"


def poor(
    config: TrainConfig,
    aihtr: float,
    others: Mapping[str, float],
    regret: float,
    task: Task,
) -> list[str]:
    """One line for each sign of a poor policy, with the option that helps.

    Args:
        config: of the run.
        aihtr: of the policy.
        others: AIHTR of simple policies, by their names.
        regret: per step, to the best policy known; nan where none but `others` is.
        task: that was learned.
    """
    if not others:
        return []
    single = config.algo.name.endswith("_per_sensor") and (task.keyed or not task.markov)
    found, name = [], max(others, key=lambda each: others[each])
    if others[name] > aihtr + (slack := 1e-6 * max(1.0, abs(aihtr))):
        # A policy of less memory, learned from the same tracks, is named by its option.
        advice = f"try {name}" if name.startswith("task.memory=") else _help(config, task)
        found.append(
            f"warning: {name} earns {others[name]:,.3f}, more than the learned policy; {advice}"
        )
    elif regret > (_NEAR if single else FAR) * task.reward:
        why = f" ({_SINGLE})" if single else ""
        said = f"warning: {regret:.3f} per step below the best policy known{why}"
        found.append(f"{said}; {_help(config, task)}")
    elif single and math.isnan(regret):
        found.append(f"note: {_SINGLE}; compare with algo=model_based")
    if config.algo.name == "model_based" and task.budget is not None and not task.markov:
        found.append(f"note: {_INFERRED}; compare with algo=a2c")
    nothing = others.get("no sensors")
    if nothing is not None and nothing >= max(aihtr, *others.values()) - slack:
        found.append("note: no policy known earns more than no sensors at all; see cost.sensor")
    return found


def _help(config: TrainConfig, task: Task) -> str:
    """The option that helps most."""
    algo = config.algo.name
    typed = "algo" if config.algo.total_frames == config.collector.total_frames else "collector"
    frames = f"try more {typed}.total_frames"
    if algo in ("a2c", "ppo", "dqn"):
        others = f"algo={algo}_per_sensor or " if task.budget is None else ""
        return f"{frames}, {others}algo=model_based"
    if algo != "model_based":
        return "try algo=model_based"
    if getattr(config.algo, "estimate", None) == "moves":
        return "try algo.estimate=null"
    return frames
