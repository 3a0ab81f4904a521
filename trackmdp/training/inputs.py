"""Inputs of a run in its folder: `config.yaml` and `problem.npz`, which a resumed or evaluated run is read from."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from trackmdp.algos.estimates.alike import cell_classes
from trackmdp.config import TrainConfig
from trackmdp.config.checks import own_paths
from trackmdp.config.learning import file_of_classes, together
from trackmdp.config.resume import fixed_options
from trackmdp.config.tree import config_text
from trackmdp.durable import write_bytes, write_text
from trackmdp.errors import UserError
from trackmdp.notebook.card import grid_words
from trackmdp.world.configured import make_problem
from trackmdp.world.group import Group, Subject, learned_in
from trackmdp.world.make import OF_TASK
from trackmdp.world.problem_file import PROBLEM, problem_bytes, problem_digest, read_problem


def write_inputs(config: TrainConfig, problem: Subject, folder: Path, *, resumed: bool) -> None:
    """Write the problem, with the classes of cells that a file gives the learner, and the config.

    A resumed run keeps its `problem.npz`: `identity` has shown that it is the same.
    """
    if not resumed:
        classes = cell_classes(file_of_classes(config.algo), problem.task.size)
        write_bytes(folder / PROBLEM, problem_bytes(problem, classes))
    # The config last: with it the folder is a run's, and all that belongs to it must be there.
    write_text(folder / "config.yaml", config_text(config, folder))


def problem_of(config: TrainConfig, folder: Path) -> Subject:
    """The problem of the run in `folder`; before it has begun, the one that its config describes.

    Raises:
        UserError: a file is missing, damaged or malformed, or is of another grid or number of targets than the config.
    """
    begun = (folder / "config.yaml").is_file()
    if begun:
        problem = read_problem(folder / PROBLEM)
        if (count := max(len(problem.targets), 1)) != (own := together(config)):
            raise UserError(f"{folder / PROBLEM}: {count} targets, expected {own}")
        if (found := problem.task.size) != (sides := config.grid.sides):
            raise UserError(
                f"{folder / PROBLEM}: {grid_words(found)}, expected {grid_words(sides)}"
            )
        return problem
    return learned_in(make_problem(config), config.targets.count, joint=config.algo.joint)


def with_own_classes(config: TrainConfig, folder: Path) -> TrainConfig:
    """The config of a begun run with the classes of cells in its own file, independent of the user's."""
    if file_of_classes(config.algo) is None:
        return config
    algo = replace(config.algo, share_cells=str(folder / PROBLEM))  # type: ignore[call-arg]
    return replace(config, algo=algo)


def words_of(given: Subject, folder: Path | None, subject: Subject | None = None) -> dict[str, Any]:
    """The options that a problem made in Python has words for; its arrays are in the run's `problem.npz`.

    Args:
        given: the problem.
        folder: of the run.
        subject: what is in that file, where it is not `given`.
    """
    words: dict[str, Any] = {"targets.count": len(given)} if isinstance(given, Group) else {}
    problem = given.single
    for name, option in OF_TASK.items():
        value = getattr(problem, name)
        # The one number that all have, or the file of the run's arrays.
        if isinstance(value, np.ndarray):
            file = str((folder or Path()).absolute() / PROBLEM)
            value = float(value[0]) if (value == value[0]).all() else file
        words[option] = value
    if problem.memory == "cell":
        words.pop("task.clip")  # nothing reads it
    if not (problem.perfect and problem.safe and problem.coverage is None):
        words |= {"sensor": "given", "sensor.wide": problem.coverage is not None}
    return words | {
        "grid.size": problem.rows if problem.rows == problem.columns else list(problem.size),
        "kernel": "given",
        "kernel.motion": problem.model is not None,
        "kernel.modes": getattr(problem, "modes", 1),
        "kernel.reveals": problem.revealed > 1,
        "kernel.markov": problem.markov,
        "kernel.digest": problem_digest(subject or given)[:16],
    }


def identity(config: TrainConfig, folder: Path, problem: Subject) -> str:
    """SHA-256 of what must not change when the run in `folder` is resumed: the problem, its classes of cells, options.

    Raises:
        UserError: the classes in the folder are damaged.
    """
    # repr writes floats with all digits, so that equal hashes mean equal options.
    options = repr(fixed_options(own_paths(config, folder)))
    classes = file_of_classes(with_own_classes(config, folder).algo)
    return hashlib.sha256(f"{options} {_digest(problem, classes)}".encode()).hexdigest()


@lru_cache(maxsize=1)
def _digest(problem: Subject, classes: str | None) -> str:
    """`problem_digest`, kept: a large problem takes a second, and each checkpoint asks for it."""
    return problem_digest(problem, cell_classes(classes, problem.task.size))
