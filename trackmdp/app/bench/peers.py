"""Other projects' training scripts against this package's learner, in the same world and on the same core."""

from __future__ import annotations

import math
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from trackmdp.app.bench.process import Usage, measured, on_one_core, timed_training, typed
from trackmdp.config import BenchmarkConfig
from trackmdp.errors import UserError
from trackmdp.policies.policy import Policy
from trackmdp.training.evaluator import ExactEvaluator
from trackmdp.world.model import World

GOAL = 0.02
"""Regret per step that the learners are timed to."""


@dataclass(frozen=True)
class Learned:
    """One training run: `curve` holds (seconds since its process began, env steps, regret per step)."""

    learner: str
    seed: int
    curve: Sequence[tuple[float, int, float]]
    usage: Usage

    def reached(self, *, settled: bool) -> tuple[float, int] | tuple[None, None]:
        """Seconds and env steps at which the regret was `GOAL` or less: first, or `settled` to the end. Or neither."""
        within = [regret <= GOAL for _, _, regret in self.curve]
        # "Settled": no later policy is worse than the goal. A curve that touches the goal once by luck has not
        # learned.
        places = [place for place, found in enumerate(within) if (all(within[place:]) if settled else found)]
        return self.curve[places[0]][:2] if places else (None, None)


def peers(cfg: BenchmarkConfig, world: World, device: torch.device) -> list[dict[str, Any]]:
    """One row per seed and learner; ours and the peers' take turns on one core.

    All are timed alike. The clock of a learner runs from the start of its process, imports and compilation included,
    and every policy on its way is valued exactly, by the same code. Each learns to the end of its budget: ours as its
    options stand, a peer for `peers_seconds`.

    A peer is a script `<name>_peer.py` in the folder `peers`; `scripts/peers/track.py` says what it is given and what
    it leaves. It runs under `.venv-<name>/bin/python` of that folder where there is one, else under this interpreter.

    Raises:
        UserError: `peers` is no folder with such scripts.
    """
    scripts = sorted(Path(cfg.peers).glob("*_peer.py"))
    if not scripts:
        raise UserError(f"peers={cfg.peers}: expected a folder with scripts called <name>_peer.py")
    evaluator = ExactEvaluator(world)
    runs = []
    with on_one_core(), tempfile.TemporaryDirectory() as folder:
        instance = Path(folder, "instance.npz")
        # A peer gets the world as plain arrays, since it runs without this package.
        arrays = {name: getattr(world, name) for name in ("cost", "safe_cost", "reward", "t_max")}
        np.savez_compressed(instance, kernel=world.kernel.toarray(), **arrays)
        # Seed by seed, all learners in turn: a machine that slows down in between slows all of them.
        for seed in cfg.seeds:
            runs.append(_ours(cfg, seed, device))
            runs += [_peer(script, instance, seed, cfg, evaluator) for script in scripts]
    # `_ours` comes first of each seed, and is what the others are compared with.
    return [_row(run, next(each for each in runs if each.seed == run.seed)) for run in runs]


def _ours(cfg: BenchmarkConfig, seed: int, device: torch.device) -> Learned:
    # `evaluation.every=1` gives the curve its points; solving for the optimum is not learning, and is left out.
    own = [f"seed={seed}", f"threads={cfg.threads}", f"device={device}", "evaluation.every=1", "optimal.enabled=false"]
    rows, usage = timed_training(*typed("grid", "kernel", "cost", "sensor"), *own)
    points = [(float(row["seconds"]), int(row["frames"]), float(row["regret_per_step"])) for row in rows]
    return Learned("trackmdp hindsight", seed, _from_start(points, usage), usage)


def _peer(script: Path, instance: Path, seed: int, cfg: BenchmarkConfig, evaluator: ExactEvaluator) -> Learned:
    name, record = script.stem.removesuffix("_peer"), instance.with_name("record.npz")
    own = script.parent / f".venv-{name}/bin/python"
    python = str(own.absolute()) if own.exists() else sys.executable
    words = [str(instance), str(record), "--seed", str(seed), "--seconds", str(cfg.peers_seconds)]
    usage = measured(*words, script=str(script), python=python, quiet=True)
    task = evaluator.world
    # `[M, t_max + 1, M]`: from each located cell, after n misses, the sensors that are on; stored as bits, 8 to a
    # byte.
    shape = (task.num_cells, task.num_choices, task.num_cells)
    # A pickle in a peer's record would be code, run in this process.
    with np.load(record, allow_pickle=False) as stored:
        tables = [np.unpackbits(bits, count=math.prod(shape)).astype(bool).reshape(shape) for bits in stored["sets"]]
        times, steps = stored["seconds"].tolist(), stored["steps"].tolist()
    regrets = [evaluator.score(Policy.from_dense(task, table)).regret_per_step for table in tables]
    points = list(zip(times, steps, regrets, strict=True))
    return Learned(f"{name} ppo", seed, _from_start(points, usage), usage)


def _from_start(points: Sequence[tuple[float, int, float]], usage: Usage) -> list[tuple[float, int, float]]:
    """Seconds of learning as seconds of the process: what it spent outside of learning counts as spent before."""
    # Wall time of the process less the clock of the last point. It includes what comes after learning, which counts
    # against every learner alike.
    outside = usage.wall_seconds - points[-1][0]
    return [(outside + seconds, steps, regret) for seconds, steps, regret in points]


def _row(run: Learned, ours: Learned) -> dict[str, Any]:
    mine, (theirs, steps) = ours.reached(settled=True)[0], run.reached(settled=True)
    return {
        "learner": run.learner,
        "seed": run.seed,
        "goal": GOAL,
        "first_seconds": run.reached(settled=False)[0],
        "settled_seconds": theirs,
        "settled_steps": steps,
        "times_ours": theirs / mine if mine and theirs else None,
        "last_regret": run.curve[-1][2],
        **asdict(run.usage),
        "curve": {"seconds": [row[0] for row in run.curve], "regret": [row[2] for row in run.curve]},
    }
