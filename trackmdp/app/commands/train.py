"""`train`: learn a policy without the motion model, and evaluate it exactly."""

from __future__ import annotations

from pathlib import Path

from trackmdp.app.commands.held_out import show_held_out, show_loaded
from trackmdp.app.commands.summary import show_summary
from trackmdp.config import TrainConfig
from trackmdp.config.resume import finished
from trackmdp.errors import RunError
from trackmdp.training.blocks import make_trainer
from trackmdp.training.display import make_console
from trackmdp.training.lock import locked
from trackmdp.training.run import complete
from trackmdp.world.make import make_problem
from trackmdp.world.tracks import Problem


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
    reached = _finished(cfg, folder)
    if reached is not None:
        console.print(f"finished before; results in {folder}")
        return reached
    problem = problem or make_problem(cfg)
    show_loaded(console, problem)
    trainer = make_trainer(problem, cfg, folder=folder, console=console)
    done = complete(trainer)
    if done.summary["held_out"] is None:
        show_summary(console, trainer, done)
    else:
        show_held_out(console, f"learned ({cfg.algo.name})", done.summary["held_out"])
    console.print(f"{done.summary['wall_seconds']:.1f} s; results in {folder}")
    return done.evaluation.aihtr


def _finished(cfg: TrainConfig, folder: Path) -> float | None:
    """The AIHTR of a run that has nothing left to do; what an older config led to does not count, and is removed."""
    if cfg.resume is None:
        return None
    summary = finished(cfg, folder)
    if summary is None:
        # It belongs to an older config; left there, whoever looks at the folder meanwhile would take this run for
        # done.
        (folder / "summary.json").unlink(missing_ok=True)
        return None
    return float(summary["policy"]["aihtr"])
