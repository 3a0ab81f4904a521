"""Inputs of a run in its folder: `config.yaml`, `kernel.npz` or `tracks.json`, footprints, tracks of no other file."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy import sparse

from trackmdp.config import TrainConfig
from trackmdp.config.learning import file_of_classes
from trackmdp.config.tree import config_text
from trackmdp.durable import write_bytes, write_text
from trackmdp.errors import UserError
from trackmdp.solvers.alike import cell_classes
from trackmdp.untrusted import parse_json, read_bytes
from trackmdp.world.files import LARGE, csr_bytes, npy_bytes
from trackmdp.world.model import Array
from trackmdp.world.track_files import recording_bytes
from trackmdp.world.tracks import Problem, Recorded

KERNEL, TRACKS = "kernel.npz", "tracks.json"
"""The motion, or how many recorded tracks of which content."""
RECORDING = "recording.npz"
"""The tracks of a run that was begun in Python, which may have been read from any file, or from none."""
FOOTPRINTS = "footprints.npz"
"""The cells that each sensor covers, where that is not its own cell alone."""
CLASSES = "classes.npy"
"""The class of each cell, where a file says which cells are alike (`algo.share_cells`)."""


def short(values: Array) -> float | list[float]:
    """One number where all cells have the same, else one for each: as an option has it."""
    return float(values[0]) if (values == values[0]).all() else values.tolist()


def write_inputs(config: TrainConfig, problem: Problem, folder: Path, *, resumed: bool) -> None:
    """Write the kernel, or which tracks these are, the classes of cells and the config; tracks in no file, too.

    Raises:
        UserError: the run that is resumed was begun with another kernel, other tracks or other classes.
    """
    contents = _contents(problem)
    classes = cell_classes(file_of_classes(config.algo), problem.size)
    if classes is not None:
        contents[CLASSES] = npy_bytes(classes)
    own = folder.absolute() / RECORDING
    # Before anything is written: a run that is refused must keep the inputs that its results belong to. And what was
    # checked stays: only the process that read the positions can say what it left out of them.
    if resumed:
        _check(contents, folder)
    else:
        if isinstance(problem, Recorded) and getattr(config.kernel, "path", None) == str(own):
            contents[RECORDING] = recording_bytes(problem)
        for name, content in contents.items():
            write_bytes(folder / name, content)
    # The config last: with it the folder is that of a run, and all that it names must be there.
    write_text(folder / "config.yaml", config_text(config, folder))


def check_inputs(problem: Problem, folder: Path) -> None:
    """See that the folder's run learned in this world, or from these tracks.

    Raises:
        UserError: its kernel, its footprints, or which tracks it names, is missing, damaged or another.
    """
    _check(_contents(problem), folder)


def _check(contents: Mapping[str, bytes], folder: Path) -> None:
    for name, content in contents.items():
        stored = read_bytes(folder / name, most=LARGE)
        if stored != content and not (name == TRACKS and _counted(stored) == _counted(content)):
            raise UserError(f"{folder / name}: not what the run's config describes now; a run's inputs cannot change")


def _counted(content: bytes) -> Any:
    """What `tracks.json` says of the tracks; what was left out of a file of positions does not count."""
    try:
        said = parse_json(content, TRACKS)
    except UserError:
        return None
    return {**said, "loaded": None} if isinstance(said, dict) else None


def _contents(problem: Problem) -> dict[str, bytes]:
    """Name -> content of the files that describe the problem; the same problem, the same bytes."""
    contents = {TRACKS: _described(problem)} if isinstance(problem, Recorded) else {KERNEL: _saved(problem.kernel)}
    if problem.coverage is not None:
        contents[FOOTPRINTS] = _saved(problem.coverage.matrix)
    return contents


def _saved(matrix: sparse.csr_array) -> bytes:
    """A CSR matrix as SciPy saves it, its indices of one width, whatever its size and whatever is fastest."""
    wide = (matrix.data, matrix.indices.astype(np.int64), matrix.indptr.astype(np.int64))
    return csr_bytes(sparse.csr_array(wide, shape=matrix.shape))


def _described(problem: Recorded) -> bytes:
    """How many tracks and points of which content, as JSON."""
    parts = {"learned_from": problem.tracks, "validation": problem.validation, "held_out": problem.held_out}
    content = {
        name: {"tracks": len(part), "cells": len(part.cells), "sha256": part.digest()} for name, part in parts.items()
    }
    content |= {"loaded": dict(problem.loaded)} if problem.loaded else {}
    return (json.dumps(content, indent=2) + "\n").encode()
