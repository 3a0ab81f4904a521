"""Inputs of a run in its folder: `config.yaml`, `kernel.npz` or `tracks.json`, footprints, tracks of no other file."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
from scipy import sparse

from trackmdp.arrays import LARGE
from trackmdp.config import TrainConfig
from trackmdp.config.resume import config_text
from trackmdp.durable import write_bytes, write_text
from trackmdp.errors import UserError
from trackmdp.solvers.alike import cell_classes
from trackmdp.untrusted import parse_json, read_bytes
from trackmdp.world.model import Array
from trackmdp.world.recording import recording_bytes
from trackmdp.world.tracks import Problem, Recorded

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
    file, content = folder / _name(problem), _content(problem)
    # Before anything is written: a run that is refused must keep the inputs that its results belong to.
    if resumed:
        check_inputs(problem, folder)
    classes = cell_classes(getattr(config.algo, "share_cells", None), problem.size)
    if classes is not None and classes.any():
        file_of_classes = folder / CLASSES
        if resumed and read_bytes(file_of_classes, most=LARGE) != npy_bytes(classes):
            raise UserError(f"{file_of_classes}: not the classes that algo.share_cells has now; they cannot change")
        write_bytes(file_of_classes, npy_bytes(classes))
    # The config last: with it the folder is that of a run, and all that it names must be there. What was checked stays:
    # only the process that read the positions can say what it left out of them.
    if not resumed:
        write_bytes(file, content)
        if problem.coverage is not None:
            write_bytes(folder / FOOTPRINTS, _saved(problem.coverage.matrix))
    own = folder.absolute() / RECORDING
    if isinstance(problem, Recorded) and getattr(config.kernel, "path", None) == str(own) and not resumed:
        write_bytes(own, recording_bytes(problem))
    write_text(folder / "config.yaml", config_text(config))


def npy_bytes(array: np.ndarray) -> bytes:
    """A .npy file."""
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


def check_inputs(problem: Problem, folder: Path) -> None:
    """See that the folder's run learned in this world, or from these tracks.

    Raises:
        UserError: its kernel, or which tracks it names, is missing, damaged or another than that of `problem`.
    """
    file = folder / _name(problem)
    if not _is_content(problem, read_bytes(file, most=LARGE)):
        what = "recording" if isinstance(problem, Recorded) else "kernel"
        raise UserError(f"{file}: the run's {what} is not the one that its config describes now; it cannot change")
    if problem.coverage is not None:
        file = folder / FOOTPRINTS
        if read_bytes(file, most=LARGE) != _saved(problem.coverage.matrix):
            raise UserError(f"{file}: the run's footprints are not those of its config now; they cannot change")


def _is_content(problem: Problem, stored: bytes) -> bool:
    """Whether `stored` describes the problem; what was left out of a file of positions does not count."""
    if not isinstance(problem, Recorded):
        return stored == _content(problem)
    try:
        found = parse_json(stored, "tracks.json")
    except UserError:
        return False
    own = json.loads(_content(problem))
    return isinstance(found, dict) and {**found, "loaded": None} == {**own, "loaded": None}


def _name(problem: Problem) -> str:
    return "tracks.json" if isinstance(problem, Recorded) else "kernel.npz"


def _content(problem: Problem) -> bytes:
    """Of `kernel.npz` or `tracks.json`; the same problem, the same bytes."""
    if isinstance(problem, Recorded):
        return _described(problem)
    return _saved(problem.kernel)


def _saved(matrix: sparse.csr_array) -> bytes:
    """A CSR matrix as SciPy saves it, its indices of one width, whatever its size and whatever is fastest."""
    buffer = io.BytesIO()
    wide = (matrix.data, matrix.indices.astype(np.int64), matrix.indptr.astype(np.int64))
    sparse.save_npz(buffer, sparse.csr_array(wide, shape=matrix.shape))
    return buffer.getvalue()


def _described(problem: Recorded) -> bytes:
    """How many tracks and points of which content, as JSON."""
    parts = {"learned_from": problem.tracks, "validation": problem.validation, "held_out": problem.held_out}
    content = {
        name: {"tracks": len(part), "cells": len(part.cells), "sha256": part.digest()} for name, part in parts.items()
    }
    content |= {"loaded": dict(problem.loaded)} if problem.loaded else {}
    return (json.dumps(content, indent=2) + "\n").encode()
