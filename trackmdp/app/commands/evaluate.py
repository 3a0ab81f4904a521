"""`evaluate`: value a trained policy or a baseline, exactly and by simulation."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from tensordict.nn import TensorDictModuleBase

from trackmdp.app.commands import held_out, playback
from trackmdp.app.commands.trained import trained
from trackmdp.build import make_baseline
from trackmdp.config import EvaluateConfig, McapConfig, PlaybackConfig, RandomKConfig, load_run_config, to_yaml
from trackmdp.durable import write_json, write_text
from trackmdp.episodes.log import EpisodeLog
from trackmdp.episodes.record import Chains, RandomSets
from trackmdp.policies import fixed
from trackmdp.policies.fixed import ChainPolicy
from trackmdp.policies.table import PolicyTable
from trackmdp.reports.picture import draw
from trackmdp.seeding import generator
from trackmdp.solvers import estimator
from trackmdp.training.devices import make_device
from trackmdp.training.display import make_console, table
from trackmdp.training.evaluate import Simulation, simulate
from trackmdp.training.evaluator import ExactEvaluator, Score, figures
from trackmdp.world.make import make_problem
from trackmdp.world.model import World
from trackmdp.world.tracks import Problem, Recorded

__all__ = ["run"]


def run(cfg: EvaluateConfig, folder: Path, problem: Problem | None = None) -> float:
    """Write `evaluation.json`, `sets.json` and `picture.txt` to `folder`; returns the exact AIHTR.

    `problem` is the world of `cfg`, where it is built already.
    """
    console = make_console(cfg.quiet)
    torch.set_num_threads(cfg.threads)
    device = make_device(cfg.device)
    if cfg.run is None and isinstance(cfg.baseline, PlaybackConfig):
        return playback.run(cfg, folder, console, device, problem)
    world, chains, subject = _trained(cfg, device) if cfg.run else _baseline(cfg, problem)
    if isinstance(world, Recorded):
        return held_out.run(world, chains, subject, folder, console, cfg.seed)
    evaluator = ExactEvaluator(world)
    sets = PolicyTable.from_dense(world, chains)
    score = evaluator.score(sets)
    simulation = None
    if cfg.episodes:
        policy: TensorDictModuleBase = ChainPolicy(chains, device)
        if isinstance(cfg.baseline, RandomKConfig):
            draws = generator(cfg.seed, "evaluation", "policy", device=device)
            policy = fixed.RandomK(world.num_cells, cfg.baseline.k, draws)
        simulation = simulate(world, policy, episodes=cfg.episodes, seed=cfg.seed, device=device)
    estimate = estimator.accuracy(world, sets) if sets.deterministic and world.max_steps is None else None
    report = _report(subject, evaluator, score, simulation) | {"estimator": asdict(estimate) if estimate else None}
    write_json(folder / "evaluation.json", report)
    if chains.dtype == np.bool_:
        write_json(folder / "sets.json", sets.as_lists())
        write_text(folder / "picture.txt", draw(world, chains, seed=cfg.seed))
    _show(console, subject, evaluator, score, simulation, folder)
    if cfg.log is not None:
        _log_episodes(cfg, world, chains, subject, folder, console)
    if estimate is not None:
        shares = (
            f"from Q {estimate.exact:.2%} (printed form {estimate.paper:.2%}), from the belief {estimate.bayes:.2%}"
        )
        console.print(f"missed steps whose position is estimated right: {shares}")
    return score.evaluation.aihtr


def _log_episodes(
    cfg: EvaluateConfig,
    world: World,
    chains: np.ndarray,
    subject: str,
    folder: Path,
    console: Console,
) -> None:
    """Write `episodes.mcap`: as many episodes as are simulated, each from a generator of its own."""
    assert isinstance(cfg.log, McapConfig)
    described = to_yaml(load_run_config(cfg.run) if cfg.run else cfg)
    log = EpisodeLog(folder, world, seed=cfg.seed, config=described, layout=cfg.log.layout, command="evaluate")
    if isinstance(cfg.baseline, RandomKConfig):
        log.record(RandomSets(world.num_cells, cfg.baseline.k), {"label": subject}, cfg.episodes)
    else:
        log.record(Chains(chains), {"label": subject}, cfg.episodes)
    if log.close():
        console.print(f"{log.episodes} episodes in {log.file}", markup=False)


def _trained(cfg: EvaluateConfig, device: torch.device) -> tuple[Problem, np.ndarray, str]:
    assert cfg.run is not None
    policy = trained(cfg.run, device)
    return policy.world, policy.chains, policy.subject


def _baseline(cfg: EvaluateConfig, problem: Problem | None) -> tuple[Problem, np.ndarray, str]:
    assert cfg.baseline is not None
    world = make_problem(cfg) if problem is None else problem
    return world, make_baseline(cfg.baseline, world), cfg.baseline.name


def _report(subject: str, evaluator: ExactEvaluator, score: Score, simulation: Simulation | None) -> dict[str, Any]:
    return {
        "policy": subject,
        "exact": figures(score.evaluation),
        "value": score.evaluation.value.tolist(),
        "simulated": asdict(simulation) if simulation else None,
        "qmdp": figures(evaluator.qmdp),
        "bounds": evaluator.bounds,
        "regret_per_step": score.regret_per_step,
    }


def _show(
    console: Console, subject: str, evaluator: ExactEvaluator, score: Score, simulation: Simulation | None, folder: Path
) -> None:
    names = {
        "aihtr": "AIHTR",
        "accuracy": "accuracy",
        "sensors_per_step": "sensors per step",
        "safe_per_episode": "safe actions per episode",
        "expected_length": "steps per episode",
    }
    exact, qmdp = figures(score.evaluation), figures(evaluator.qmdp)
    rows = []
    for key, label in names.items():
        estimate = getattr(simulation, key) if simulation else None
        simulated = f"{estimate.mean:,.4f} ± {estimate.standard_error:.4f}" if estimate else ""
        rows.append([label, f"{exact[key]:,.4f}", simulated, f"{qmdp[key]:,.4f}"])
    title = f"simulated, {simulation.episodes} episodes ± s.e." if simulation else "simulated"
    console.print(table(subject, ["figure", "exact", title, "Q_MDP exact"], rows))
    regret = round(score.regret_per_step, 4) + 0.0
    console.print(f"upper bound (clocked) {evaluator.upper:,.4f}; regret per step {regret:.4f}; results in {folder}")
