"""`train`: learn a policy without the motion model, and judge it exactly."""

from __future__ import annotations

import dataclasses
import hashlib
import io
import json
import math
import platform
import time
from contextlib import ExitStack
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from torchrl.collectors import BaseCollector

from trackmdp import __version__
from trackmdp.algos.common import Algorithm
from trackmdp.build import make_algorithm, make_collector, make_device, make_world
from trackmdp.config import Mcap, TrainConfig, to_yaml
from trackmdp.episodes.log import EpisodeLog
from trackmdp.episodes.record import Chains
from trackmdp.errors import RunError, UserError
from trackmdp.seeding import seed_global
from trackmdp.solvers import optimal
from trackmdp.solvers.optimal import Solution
from trackmdp.training import checkpoint, memory
from trackmdp.training.display import Display, make_console, table
from trackmdp.training.judge import Judge, Verdict, figures
from trackmdp.training.lock import locked
from trackmdp.training.loop import Intervals, Position, train
from trackmdp.training.metrics import MetricsLog, write_bytes, write_json, write_text
from trackmdp.training.state import capture, find, restore, take_weights
from trackmdp.world.model import World

__all__ = ["run"]


def run(cfg: TrainConfig, folder: Path) -> float:
    """Train as `cfg` says and write config, kernel, metrics, checkpoints and summary to `folder`; returns the AIHTR.

    Raises:
        UserError: the config asks for what is not there, or for more memory than there is.
        RunError: learning or writing broke down.
        Preempted: a signal ended the run; it can go on.
    """
    try:
        with locked(folder):
            return _run(cfg, folder)
    except OSError as error:
        if not folder.is_dir():
            raise RunError(f"hydra.run.dir={folder}: the folder was removed while the run wrote to it") from error
        raise RunError(
            f"{error.filename or folder}: {error.strerror or error}; resume=auto goes on from the last checkpoint"
        ) from error


def _run(cfg: TrainConfig, folder: Path) -> float:
    started, used = time.monotonic(), time.process_time()
    console = make_console(cfg.quiet)
    reached = _finished(cfg, folder)
    if reached is not None:
        console.print(f"finished before; results in {folder}")
        return reached
    torch.set_num_threads(cfg.threads)
    device = make_device(cfg.device)
    world = make_world(cfg)
    console.print(memory.check(cfg, world.task, device))
    state, passed_over = find(cfg, folder, device)
    for line in passed_over:
        console.print(f"passed over: {line}")
    with ExitStack() as opened:
        seed_global(cfg.seed)
        algorithm = make_algorithm(cfg, world, device)
        collector = make_collector(cfg, world, algorithm, device, done=state["position"]["frames"] if state else 0)
        opened.callback(collector.shutdown)
        judge = Judge(world, cfg.grid.max_steps)
        start = _start(cfg, algorithm, collector, state, console, device)
        written, best = (state["metrics"], state["best"]) if state else (0, -math.inf)
        _write_inputs(cfg, world, folder, resumed=state is not None)
        del state  # it may hold a replay buffer
        events = cfg.log.name == "tensorboard"
        metrics = MetricsLog(folder, tensorboard=events, position=written, frames=start.frames)
        opened.callback(metrics.close)
        log = _episode_log(cfg, world, folder)
        if log is not None:
            opened.callback(log.close)

        def save(at: Position, verdict: Verdict) -> None:
            nonlocal best
            better = verdict.evaluation.aihtr > best
            best = max(best, verdict.evaluation.aihtr)
            content = capture(cfg, algorithm, collector, at, metrics=metrics.position, best=best)
            checkpoint.save(folder / "checkpoints", at.iteration, content, keep=cfg.checkpoint.keep, best=better)

        def record(iteration: int, chains: np.ndarray) -> None:
            if log is not None and isinstance(cfg.log, Mcap) and _recorded(cfg, iteration, algorithm.iterations):
                log.record(Chains(chains), {"label": f"iteration {iteration}"}, cfg.log.episodes, iteration)

        every = Intervals(cfg.evaluation.every, cfg.log.every, cfg.checkpoint.every, cfg.checkpoint.seconds)
        title = f"{cfg.algo.name} seed {cfg.seed}"
        with Display(console, title, algorithm.iterations, start.iteration, start.frames) as display:
            verdict, end = train(algorithm, collector, judge, metrics, display, every, save, start, record)
    solution = _solve(cfg, world, console)
    if solution is not None:
        verdict = judge.tighten(solution.upper, verdict)
    times = {
        "wall_seconds": time.monotonic() - started + start.seconds,
        "cpu_seconds": time.process_time() - used,
    }
    write_json(folder / "summary.json", _summary(cfg, judge, verdict, solution, end.frames, times))
    _show(console, cfg, judge, verdict, solution)
    console.print(f"{times['wall_seconds']:.1f} s; results in {folder}")
    return verdict.evaluation.aihtr


def _finished(cfg: TrainConfig, folder: Path) -> float | None:
    """The AIHTR of a run that has nothing left to do; what an older config led to does not count, and is removed."""
    file = folder / "summary.json"
    if cfg.resume is None or not file.is_file():
        return None
    summary = json.loads(file.read_text(encoding="utf-8"))
    if summary["config_sha256"] in [_digest(dataclasses.replace(cfg, quiet=quiet)) for quiet in (True, False)]:
        return float(summary["policy"]["aihtr"])
    file.unlink()
    return None


def _digest(cfg: TrainConfig) -> str:
    return hashlib.sha256(to_yaml(dataclasses.replace(cfg, resume=None)).encode()).hexdigest()


def _start(
    cfg: TrainConfig,
    algorithm: Algorithm,
    collector: BaseCollector,
    state: dict[str, Any] | None,
    console: Console,
    device: torch.device,
) -> Position:
    """Where the run begins: after its last checkpoint, or from scratch, perhaps with the weights of another run."""
    if state is not None:
        start = restore(state, algorithm, collector)
        console.print(f"goes on after iteration {start.iteration}, {start.frames:,} frames")
        return start
    if cfg.init_from is not None:
        console.print(
            f"weights from {cfg.init_from}: {', '.join(take_weights(algorithm, Path(cfg.init_from), device))}"
        )
    return Position()


def _episode_log(cfg: TrainConfig, world: World, folder: Path) -> EpisodeLog | None:
    """The log of simulated episodes, where it is asked for."""
    if not isinstance(cfg.log, Mcap):
        return None
    described = to_yaml(dataclasses.replace(cfg, resume=None))
    return EpisodeLog(
        folder,
        world,
        seed=cfg.seed,
        config=described,
        max_steps=cfg.grid.max_steps,
        layout=cfg.log.layout,
        command="train",
    )


def _recorded(cfg: TrainConfig, iteration: int, last: int) -> bool:
    """Whether episodes of the evaluation after an iteration are logged: the first, every k-th, and the last."""
    assert isinstance(cfg.log, Mcap)
    return iteration in (1, last) or iteration % (cfg.evaluation.every * cfg.log.evaluations) == 0


def _solve(cfg: TrainConfig, world: World, console: Console) -> Solution | None:
    """The certified optimum, where it is asked for; there is none for episodes cut by `grid.max_steps`."""
    if not cfg.optimal.enabled or cfg.grid.max_steps is not None:
        return None
    with console.status(f"solving for the optimum, at most {cfg.optimal.time_limit:g} s"):
        return optimal.solve(world, time_limit=cfg.optimal.time_limit)


def _write_inputs(cfg: TrainConfig, world: World, folder: Path, *, resumed: bool) -> None:
    """`config.yaml` and `kernel.npy`: all that it takes to do the run again.

    Raises:
        UserError: the run that goes on was begun with another kernel.
    """
    file = folder / "kernel.npy"
    if resumed and not np.array_equal(np.load(file, allow_pickle=False), world.kernel):
        raise UserError(
            f"{file}: the run's kernel is not the one that its config describes now; it cannot change on resume"
        )
    write_text(folder / "config.yaml", to_yaml(dataclasses.replace(cfg, resume=None)))
    buffer = io.BytesIO()
    np.save(buffer, world.kernel)
    write_bytes(file, buffer.getvalue())


def _summary(
    cfg: TrainConfig,
    judge: Judge,
    verdict: Verdict,
    solution: Solution | None,
    frames: int,
    times: dict[str, float],
) -> dict[str, Any]:
    packages = ("torch", "torchrl", "tensordict", "hydra-core", "numpy", "scipy")
    return {
        "algo": cfg.algo.name,
        "seed": cfg.seed,
        "frames": frames,
        **times,
        "policy": figures(verdict.evaluation),
        "qmdp": figures(judge.qmdp),
        "bounds": judge.bounds,
        "optimal": {"lower": solution.lower, "upper": solution.upper, "certified": solution.certified}
        if solution
        else None,
        "regret_per_step": verdict.regret_per_step,
        "versions": {"trackmdp": __version__, "python": platform.python_version()}
        | {name: version(name) for name in packages},
        "config_sha256": _digest(cfg),
    }


def _show(console: Console, cfg: TrainConfig, judge: Judge, verdict: Verdict, solution: Solution | None) -> None:
    shape = (judge.world.num_cells, judge.world.num_choices, judge.world.num_cells)
    policies = {
        f"learned ({cfg.algo.name})": verdict.evaluation,
        "Q_MDP": judge.qmdp,
        "all on": judge.evaluate(np.ones(shape, dtype=bool)),
    }
    if solution is not None:
        policies["optimum" if solution.certified else "best known"] = judge.evaluate(solution.chains)
    rows = [
        [name, f"{e.aihtr:,.3f}", f"{100 * e.accuracy:.2f} %", f"{e.sensors_per_step:.2f}"]
        for name, e in policies.items()
    ]
    rows.append(["upper bound", f"{judge.upper:,.3f}", "", ""])
    console.print(table("exact values", ["policy", "AIHTR", "accuracy", "sensors per step"], rows))
    regret = round(verdict.regret_per_step, 4) + 0.0
    console.print(f"regret per step {regret:.4f} to the upper bound")
