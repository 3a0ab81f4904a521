"""`train`: learn a policy from Python; names and defaults are those of the command line."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np

from trackmdp.config import GROUPS, SELECTORS, TrainConfig, options
from trackmdp.config.compose import compose
from trackmdp.config.loggers import require_packages
from trackmdp.errors import UserError
from trackmdp.seeding import preserved_global_rng
from trackmdp.training.blocks import make_trainer
from trackmdp.training.callbacks import Callback
from trackmdp.training.display import make_console
from trackmdp.training.inputs import FOOTPRINTS, RECORDING, short
from trackmdp.training.lock import locked
from trackmdp.training.run import Run, complete
from trackmdp.world.make import sensor_words
from trackmdp.world.model import World
from trackmdp.world.modes import HiddenWorld
from trackmdp.world.tracks import Problem


def train(
    problem: Problem,
    algo: str = "hindsight",
    *,
    seed: int = 0,
    folder: str | Path | None = None,
    progress: bool = False,
    callbacks: Sequence[Callback] = (),
    **options: Any,
) -> Run:
    """Learn a sensing policy without the motion model, and evaluate it exactly.

    ::

        run = train(world, "ppo", total_frames=100_000, learning_rate={"end": 1e-4}, **{"collector.envs": 64})

    Args:
        problem: the world, or recorded tracks; the learner is given its task alone.
        algo: name of the algorithm, as in `trackmdp train algo=...`.
        seed: every random draw of the run derives from it; torch's global generators are left as they were.
        folder: made if it is missing, and written to as the command does; None to write nothing. With
            ``resume="auto"`` a run in it is resumed.
        progress: show it at the terminal.
        callbacks: see `trackmdp.training.callbacks`.
        options: those of the command line. A name without a dot that the command does not have is the algorithm's;
            a dict holds several options of one node.

    Raises:
        UserError: a name, type or range is wrong, there is not enough memory, or the folder holds another run.
        RunError: learning or writing broke down.
        Preempted: a signal ended the run; with a folder it can be resumed.
    """
    place = None if folder is None else Path(folder)
    given = {_key(name): value for name, value in options.items()} | {"algo": algo, "seed": seed, "quiet": not progress}
    config: TrainConfig = compose("train", given | _described(problem, place))
    if place is not None:
        require_packages(config.log)
        place.mkdir(parents=True, exist_ok=True)
        if config.resume is None and (place / "config.yaml").is_file():
            raise UserError(f"folder={folder}: holds a run already; resume it by resume='auto', or choose another one")
    with locked(place, "folder") if place else nullcontext(), preserved_global_rng():
        console = make_console(quiet=not progress)
        return complete(make_trainer(problem, config, folder=place, callbacks=callbacks, console=console))


def _key(name: str) -> str:
    """The option, or group of them, that an argument names."""
    known = "." in name or name in options(TrainConfig) or name in SELECTORS or name in GROUPS
    return name if known else f"algo.{name}"


def _described(problem: Problem, folder: Path | None) -> dict[str, Any]:
    """The options that a problem made in Python is described by: what is in memory counts, and the folder keeps it."""
    price = problem.cost
    given: dict[str, Any] = {
        "grid.size": problem.rows if problem.rows == problem.columns else list(problem.size),
        "grid.t_max": problem.t_max,
        "grid.max_steps": problem.max_steps,
        "grid.window": problem.window,
        "task.memory": problem.memory,
        "cost.reward": problem.reward,
        "cost.sensor": short(price),
        # null means the sum of all prices: that is what most problems have, up to the rounding of a sum in another
        # order.
        "cost.safe": None if np.isclose(problem.safe_cost, price.sum(), rtol=1e-15) else problem.safe_cost,
    }
    given |= sensor_words(short(problem.detection), short(problem.safe_detection))
    if problem.coverage is not None:
        given |= {"sensor": "footprint", "sensor.path": str((folder or Path()).absolute() / FOOTPRINTS)}
    if problem.memory != "cell":
        given["task.clip"] = problem.clip
    if isinstance(problem, World):
        where = (folder or Path()).absolute() / "kernel.npz"
        return given | {"kernel": "table", "kernel.path": str(where)}
    if isinstance(problem, HiddenWorld):
        if folder is not None:
            raise UserError("folder: a world with a hidden mode made in Python is in no file; expected folder=None")
        # `heading` stands for any: the world is in memory
        return given | {"kernel": "heading", "kernel.reveals": problem.revealed > 1}
    # Without a folder a path must be given all the same, and nothing reads it: the tracks are in memory.
    tracks = {
        "kernel": "tracks",
        "kernel.path": str((folder or Path()).absolute() / RECORDING),
        "kernel.markov": problem.markov,
        "kernel.starts": "anywhere" if problem.anywhere else "first",
        "kernel.min_length": 1,  # however short they are, they were taken
    }
    return given | tracks
