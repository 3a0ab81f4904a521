"""`train`: learn a policy without the motion model, and evaluate it exactly."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from trackmdp.config import TrainConfig
from trackmdp.errors import RunError
from trackmdp.policies.policy import Policy
from trackmdp.training.blocks import make_trainer
from trackmdp.training.callbacks import Learning
from trackmdp.training.display import make_console, show_held_out, table
from trackmdp.training.folders import SUMMARY, finished
from trackmdp.training.lock import locked
from trackmdp.training.run import Run, complete
from trackmdp.world.gridding import said
from trackmdp.world.make import make_problem
from trackmdp.world.tracks import Problem, Recorded


def run(cfg: TrainConfig, folder: Path, problem: Problem | None = None) -> float:
    """Train as `cfg` says and write inputs, metrics, checkpoints, policy and summary to `folder`; returns the AIHTR.

    Args:
        cfg: the checked config.
        folder: of the run.
        problem: the world or the tracks of `cfg`, where they are built already.

    Raises:
        UserError: the config asks for what is not there, or for more memory than there is.
        RunError: learning or writing broke down.
        Preempted: a signal ended the run; it can be resumed.
    """
    try:
        with locked(folder):
            return _run(cfg, folder, problem)
    except OSError as error:
        # Somebody tidied up while the run was on; "no such file" about a part of a checkpoint would puzzle.
        if not folder.is_dir():
            raise RunError(f"hydra.run.dir={folder}: the folder was removed while the run wrote to it") from error
        raise RunError(
            f"{error.filename or folder}: {error.strerror or error}; resume=auto resumes from the last checkpoint"
        ) from error


def _run(cfg: TrainConfig, folder: Path, problem: Problem | None) -> float:
    console = make_console(cfg.quiet)
    if cfg.resume is not None:
        if summary := finished(cfg, folder):
            console.print(f"finished before; results in {folder}")
            return float(summary["policy"]["aihtr"])
        # It belongs to an older config; left there, whoever looks at the folder meanwhile would take this run for
        # done.
        (folder / SUMMARY).unlink(missing_ok=True)
    problem = problem or make_problem(cfg)
    if isinstance(problem, Recorded) and problem.loaded:
        console.print(f"loaded: {said(problem.loaded)}")
    trainer = make_trainer(problem, cfg, folder=folder, console=console)
    done = complete(trainer)
    if done.summary["held_out"] is None:
        _show_summary(console, trainer, done)
    else:
        show_held_out(console, f"learned ({cfg.algo.name})", done.summary["held_out"])
    console.print(f"{done.summary['wall_seconds']:.1f} s; results in {folder}")
    return done.evaluation.aihtr


def _show_summary(console: Console, trainer: Learning, run: Run) -> None:
    """The learned policy beside Q_MDP, all sensors on, and the optimum where it was solved for."""
    evaluator, solution = trainer.evaluator, run.solution
    policies = {f"learned ({trainer.config.algo.name})": run.evaluation}
    if evaluator.qmdp is not None:
        policies["Q_MDP"] = evaluator.qmdp
    policies["all on"] = evaluator.evaluate(Policy.all_on(evaluator.world))
    if solution is not None:
        policies["optimum" if solution.certified else "best known"] = solution.evaluation
    rows = [
        [name, f"{e.aihtr:,.3f}", f"{100 * e.accuracy:.2f} %", f"{e.sensors_per_step:.2f}"]
        for name, e in policies.items()
    ]
    rows.append(["upper bound", f"{evaluator.upper:,.3f}", "", ""])
    console.print(table("exact values", ["policy", "AIHTR", "accuracy", "sensors per step"], rows))
    console.print(trainer.evaluator.score(run.policy).regret)
    if solution is not None and solution.timed_out:
        console.print(f"optimum: {solution.ended}")
