"""`train`: learn a policy without the motion model, and evaluate it exactly."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

from rich.console import Console

from trackmdp.config import TrainConfig
from trackmdp.recordings.gridding import said
from trackmdp.training import notices
from trackmdp.training.blocks import make_trainer
from trackmdp.training.callbacks import Learning
from trackmdp.training.display import make_console, show_held_out, table
from trackmdp.training.folders import finished
from trackmdp.training.group_run import Several
from trackmdp.training.inputs import problem_of
from trackmdp.training.lock import locked_run
from trackmdp.training.run import Run, complete
from trackmdp.world.group import Subject


def run(cfg: TrainConfig, folder: Path, problem: Subject | None = None) -> float:
    """Train by `cfg` and write inputs, metrics, checkpoints, policy and summary to `folder`; returns the AIHTR.

    Args:
        cfg: the checked config.
        folder: of the run.
        problem: the world or the tracks of `cfg`, where they are built already.

    Raises:
        UserError: the config names a missing file, or needs more memory than is free.
        RunError: learning or writing broke down.
        Preempted: a signal ended the run; it can be resumed.
    """
    with locked_run(folder):
        return _run(cfg, folder, problem)


def _run(cfg: TrainConfig, folder: Path, problem: Subject | None) -> float:
    console = make_console(cfg.quiet)
    if cfg.resume is not None and (summary := finished(cfg, folder)):
        console.print(f"finished before; results in {folder}")
        return float(summary["policy"]["aihtr"])
    problem = problem or problem_of(cfg, folder)
    if why := notices.why_chosen(cfg, problem):
        console.print(why)
    if (recorded := problem.recorded) is not None:
        if recorded.loaded:
            console.print(f"loaded: {said(recorded.loaded)}")
        if getattr(cfg.cost, "safe", 0.0) is None:
            price = f"D = {recorded.safe_cost:,.6g}, the sum of all prices"
            console.print(f"cost.safe: {price}; set the price of finding a lost target")
    trainer = make_trainer(problem, cfg, folder, console)
    done = complete(trainer)
    if done.several is not None:
        _show_several(console, cfg, done.several)
    elif done.summary["held_out"] is None:
        _show_summary(console, trainer, done)
    else:
        show_held_out(console, f"learned ({cfg.algo.name})", done.summary["held_out"])
        figures = done.summary["held_out"]["figures"].items()
        others = {name: each["aihtr"]["mean"] for name, each in figures if name != "policy"}
        _warn(console, trainer, done, others)
    console.print(f"{done.summary['wall_seconds']:.1f} s; results in {folder}")
    return done.evaluation.aihtr


def _show_summary(console: Console, trainer: Learning, run: Run) -> None:
    """The learned policy beside Q_MDP, all sensors on, and the optimum where it was solved for."""
    evaluator, solution = trainer.evaluator, run.solution
    learned = {f"learned ({trainer.config.algo.name})": run.summary["policy"]}
    policies = learned | {"Q_MDP": run.summary["qmdp"]} | run.summary["references"]
    if solution is not None and solution.certified:
        policies["optimum"] = policies.pop("best known")
    rows = [
        [
            name,
            f"{each['aihtr']:,.3f}",
            f"{100 * each['accuracy']:.2f} %",
            f"{each['sensors_per_step']:.2f}",
        ]
        for name, each in policies.items()
    ]
    rows.append(["upper bound", f"{evaluator.upper:,.3f}", "", ""])
    console.print(table("exact values", ["policy", "AIHTR", "accuracy", "sensors per step"], rows))
    console.print(trainer.evaluator.score(run.policy).regret)
    references = ("Q_MDP", "all on", "no sensors")
    others = {name: policies[name]["aihtr"] for name in references if policies.get(name)}
    _warn(console, trainer, run, others)
    if solution is not None and solution.timed_out:
        console.print(f"optimum: {solution.ended}")


def _show_several(console: Console, cfg: TrainConfig, several: Several) -> None:
    """The policy for all targets beside the merged optimum of single ones, and the bound."""
    found = several.figures
    merged = "" if cfg.algo.joint else ", merged"
    heads = ["policy", "AIHTR", "reward per step", "accuracy", "sensors per step"]
    rows = several.rows(f"learned ({cfg.algo.name}){merged}")
    console.print(table(f"{cfg.targets.count} targets, {found.about}", heads, rows))
    if several.group.recorded is None:
        console.print(several.score.regret)


def _warn(console: Console, trainer: Learning, run: Run, others: Mapping[str, float]) -> None:
    """Print the signs of a poor policy."""
    # To no policy but those in `others` where no optimum was solved for.
    regret = run.summary["regret_per_step_lower"] if run.solution is not None else math.nan
    task = trainer.problem.task
    for line in notices.poor(trainer.config, run.evaluation.aihtr, others, regret, task):
        console.print(line)
