"""`train`: learn a policy without the motion model, and evaluator it exactly."""

from __future__ import annotations

import time
from pathlib import Path

from rich.console import Console

from trackmdp.app.commands.held_out import show_held_out
from trackmdp.app.commands.session import Session
from trackmdp.app.commands.summary import show, summarize
from trackmdp.config import TrainConfig
from trackmdp.config.resume import finished
from trackmdp.durable import write_json
from trackmdp.errors import RunError
from trackmdp.reports import policy
from trackmdp.solvers import optimal
from trackmdp.solvers.optimal import Solution
from trackmdp.training.display import make_console
from trackmdp.training.evaluator import ExactEvaluator
from trackmdp.training.lock import locked
from trackmdp.world.model import World
from trackmdp.world.tracks import Problem

__all__ = ["run"]


def run(cfg: TrainConfig, folder: Path, problem: Problem | None = None) -> float:
    """Train as `cfg` says and write inputs, metrics, checkpoints, policy and summary to `folder`; returns the AIHTR.

    Args:
        cfg: the checked config.
        folder: of the run.
        problem: the world or the tracks of `cfg`, where they are built already.

    Raises:
        UserError: the config asks for what is not there, or for more memory than there is.
        RunError: learning or writing broke down.
        Preempted: a signal ended the run; it can go on.
    """
    try:
        with locked(folder):
            return _run(cfg, folder, problem)
    except OSError as error:
        if not folder.is_dir():
            raise RunError(f"hydra.run.dir={folder}: the folder was removed while the run wrote to it") from error
        raise RunError(
            f"{error.filename or folder}: {error.strerror or error}; resume=auto goes on from the last checkpoint"
        ) from error


def _run(cfg: TrainConfig, folder: Path, problem: Problem | None) -> float:
    started, used = time.monotonic(), time.process_time()
    console = make_console(cfg.quiet)
    reached = _finished(cfg, folder)
    if reached is not None:
        console.print(f"finished before; results in {folder}")
        return reached
    with Session(cfg, folder, console, problem) as session:
        score, end = session.train()
    evaluator, chains, solution, held_out = session.evaluator, session.chains(), None, None
    if isinstance(evaluator, ExactEvaluator):
        solution = _solve(cfg, evaluator.world, console)
        score = evaluator.tighten(solution.upper, score) if solution is not None else score
    else:
        held_out = evaluator.report(chains)
    times = {
        "wall_seconds": time.monotonic() - started + session.start.seconds,
        "cpu_seconds": time.process_time() - used,
    }
    policy.write(folder / policy.FILE, policy.Policy(chains, score.evaluation.value))
    write_json(folder / "summary.json", summarize(cfg, evaluator, score, solution, end, times, held_out))
    if isinstance(evaluator, ExactEvaluator):
        show(console, cfg, evaluator, score, solution)
    elif held_out is not None:
        show_held_out(console, f"learned ({cfg.algo.name})", held_out)
    console.print(f"{times['wall_seconds']:.1f} s; results in {folder}")
    return score.evaluation.aihtr


def _finished(cfg: TrainConfig, folder: Path) -> float | None:
    """The AIHTR of a run that has nothing left to do; what an older config led to does not count, and is removed."""
    if cfg.resume is None:
        return None
    summary = finished(cfg, folder)
    if summary is None:
        (folder / "summary.json").unlink(missing_ok=True)
        return None
    return float(summary["policy"]["aihtr"])


def _solve(cfg: TrainConfig, world: World, console: Console) -> Solution | None:
    """The certified optimum, where it is asked for; there is none for episodes cut by `grid.max_steps`."""
    if not cfg.optimal.enabled or cfg.grid.max_steps is not None:
        return None
    with console.status(f"solving for the optimum, at most {cfg.optimal.time_limit:g} s"):
        return optimal.solve(world, time_limit=cfg.optimal.time_limit)
