"""The content of `summary.json`, made at the end of a training run."""

from __future__ import annotations

import platform
from importlib.metadata import version
from typing import Any

from trackmdp import __version__
from trackmdp.config.tree import config_digest
from trackmdp.solvers.evaluation import Evaluation
from trackmdp.solvers.solution import Solution
from trackmdp.training.callbacks import Learning
from trackmdp.training.evaluator import Score, figures, while_collecting
from trackmdp.training.machine import machine

_PACKAGES = ("torch", "torchrl", "tensordict", "hydra-core", "numpy", "scipy")


def summarize(
    trainer: Learning, final: Evaluation, score: Score, solution: Solution | None, times: dict[str, float]
) -> dict[str, Any]:
    """The figures of a run that has ended; on recorded tracks there are no bounds, no Q_MDP and no regret.

    Args:
        trainer: of the run.
        final: figures of the last policy.
        score: of the last policy, its regret to the best bound known by now; on recorded tracks it is of others than
            `final`, and stands under `validation`.
        solution: the optimum or a bracket of it, where it was solved for.
        times: seconds spent, by their names in the summary.
    """
    config, evaluator, end = trainer.config, trainer.evaluator, trainer.position
    return {
        "algo": config.algo.name,
        "credit": config.algo.credit,
        "seed": config.seed,
        "frames": end.frames,
        **times,
        "policy": figures(final),
        "validation": None if final is score.evaluation else figures(score.evaluation),
        "qmdp": figures(evaluator.qmdp) if evaluator.qmdp else None,
        "bounds": evaluator.bounds,
        "optimal": {key: getattr(solution, key) for key in ("lower", "upper", "certified", "timed_out")}
        if solution
        else None,
        "regret_per_step": score.regret_per_step,
        "regret_per_step_lower": score.regret_per_step_lower,
        "while_collecting": while_collecting(evaluator.upper, final, end.reward, end.frames),
        "held_out": evaluator.report(trainer.policy()),
        "versions": {"trackmdp": __version__, "python": platform.python_version()}
        | {name: version(name) for name in _PACKAGES},
        "machine": machine(),
        "config_sha256": config_digest(config, trainer.folder),
    }
