"""`problem.npz`: a world or recorded tracks in a file, one array or more for each argument of their constructor.

A number or a word is an array without axes, an argument with parts has an array NAME.PART for each. A 3 x 3 world:

    kind      "World"                        size    (3, 3)
    kernel.data, kernel.indices, kernel.indptr, kernel.shape     a sparse matrix, as `coverage` is
    cost      (9 numbers)                    t_max   1

Recorded tracks have `tracks.cells`, `tracks.first`, `tracks.exits` and `tracks.names`, and so do their other two parts.
An argument that is None has no array: None is its default. A group has the arrays of its first world, with the kernels
of all kinds as blocks of one matrix, or of its recorded tracks; and `members`, the kind of each target.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Collection, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, BinaryIO, TypeAlias

import numpy as np
from scipy import sparse

from trackmdp.arrays.files import csr_of, npz_bytes
from trackmdp.arrays.types import AnyArray, IndexArray, Indices
from trackmdp.errors import UserError
from trackmdp.grid.place import Place
from trackmdp.recordings.tracks import Recorded, Tracks
from trackmdp.sensing.coverage import Coverage
from trackmdp.untrusted import LARGE, decoded, load_npz, opened
from trackmdp.world.group import Group, Subject, group_of
from trackmdp.world.model import World

PROBLEM = "problem.npz"

_KINDS = {kind.__name__: kind for kind in (World, Recorded)}
_TRACKS = {field.name for field in fields(Tracks)}

Arrays: TypeAlias = dict[str, AnyArray]


def problem_arrays(problem: Subject, classes: IndexArray | None = None) -> Arrays:
    """The arrays of `problem.npz`.

    Args:
        problem: the world or the recorded tracks.
        classes: `[M]` class of each cell, where a learner was given them (`algo.share_cells`).
    """
    first = problem.single
    given = {field.name: getattr(first, field.name) for field in fields(first)}
    if isinstance(problem, Group):
        given["members"] = problem.kind
        if problem.recorded is None:
            given["kernel"] = problem.kernel
    return as_arrays({"kind": type(problem).__name__, **given, "classes": classes})


def problem_bytes(problem: Subject, classes: IndexArray | None = None) -> bytes:
    """The content of `problem.npz`; the same problem gives the same bytes. Arguments as of `problem_arrays`."""
    return npz_bytes(problem_arrays(problem, classes))


def problem_digest(problem: Subject, classes: IndexArray | None = None) -> str:
    """SHA-256 of all arrays of a problem, independent of their compression. Arguments as of `problem_arrays`."""
    return _digest(problem_arrays(problem, classes))


def digest_of(file: Path, arguments: Collection[str]) -> str:
    """SHA-256 of the arrays of some arguments in a `problem.npz`.

    Raises:
        UserError: the file is missing or damaged.
    """
    with opened(file, most=LARGE) as stream, decoded(str(file), "a world or recorded tracks"):
        arrays = load_npz(stream)
    return _digest({name: arrays[name] for name in arrays if name.partition(".")[0] in arguments})


def _digest(arrays: Arrays) -> str:
    digest = hashlib.sha256()
    for name, array in arrays.items():
        digest.update(f"{name} {array.dtype} {array.shape}".encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


def read_problem(file: Path) -> Subject:
    """The problem in a `problem.npz`.

    Raises:
        UserError: the file is missing or damaged, or holds no problem.
    """
    with opened(file, most=LARGE) as stream, decoded(str(file), "a world or recorded tracks"):
        return subject_in(stream)


def subject_in(stream: BinaryIO) -> Subject:
    """The problem in the content of a `problem.npz`; call it inside `untrusted.decoded`."""
    given = from_arrays(load_npz(stream))
    given.pop("classes", None)
    kind, members = given.pop("kind"), given.pop("members", None)
    if kind == "Group" and "tracks" not in given:
        return _group(given, members)
    problem = _KINDS["Recorded" if kind == "Group" else kind](**given)
    if isinstance(problem, Recorded):
        for part in (problem.tracks, problem.validation, problem.held_out):
            _check_tracks(part, problem.num_cells)
    return group_of(problem, len(members)) if kind == "Group" else problem


def _group(given: dict[str, Any], members: Indices) -> Group:
    """The group of the arguments of its first world, with the `kernel` of all kinds and the kind of each target."""
    kernel = given.pop("kernel")
    states = math.prod(map(int, given["size"])) * int(given.get("modes", 1))
    kinds = np.unique(members)
    numbered = members.ndim == 1 and np.array_equal(kinds, range(len(kinds)))
    if not numbered or kernel.shape != (len(kinds) * states,) * 2:
        raise ValueError(f"kinds {members.shape} of {kernel.shape} states")
    # A target keeps its motion, so that all moves are in the blocks on the diagonal.
    places = [slice(kind * states, (kind + 1) * states) for kind in kinds]
    blocks = [kernel[place][:, place] for place in places]
    if sum(block.nnz for block in blocks) != kernel.nnz:
        raise ValueError("moves from one kind of target to another")
    worlds = [World(block, **given) for block in blocks]
    return Group([worlds[kind] for kind in members])


def as_arrays(given: Mapping[str, Any]) -> Arrays:
    """Arguments of a constructor as arrays; see the module."""
    found: Arrays = {}
    for name, value in given.items():
        parts = _parts(value)
        if parts is not None:
            found |= {f"{name}.{key}": np.asarray(part) for key, part in parts.items()}
        elif value is not None:
            found[name] = np.asarray(value)
    return found


def _parts(value: Any) -> Mapping[str, Any] | None:
    """The parts of an argument that is stored in several arrays; None of one that is not."""
    matrix = value.matrix if isinstance(value, Coverage) else value
    if sparse.issparse(matrix):
        # Fixed widths: SciPy's own choice depends on the number of entries, and digests would with it.
        return {
            "data": matrix.data,
            "indices": matrix.indices.astype(np.int32),
            "indptr": matrix.indptr.astype(np.int64),
            "shape": matrix.shape,
        }
    if isinstance(value, Tracks):
        value = {name: getattr(value, name) for name in sorted(_TRACKS)}
    elif isinstance(value, Place):
        value = value.facts()
    if not isinstance(value, Mapping):
        return None
    return {name: part for name, part in value.items() if part is not None}


def from_arrays(arrays: Mapping[str, AnyArray]) -> dict[str, Any]:
    """The arguments that `as_arrays` made arrays of.

    Raises:
        ValueError, TypeError: the parts of one do not fit together.
    """
    given: dict[str, Any] = {}
    parts: dict[str, Arrays] = {}
    for name, array in arrays.items():
        head, _, part = name.partition(".")
        if part:
            parts.setdefault(head, {})[part] = array
        else:
            given[name] = array.item() if array.ndim == 0 else array
    return given | {name: _whole(each) for name, each in parts.items()}


def _whole(parts: Arrays) -> Any:
    """A sparse matrix, tracks, a place, or plain counts, whichever has parts of these names."""
    if "indptr" in parts:
        return csr_of(parts)
    # Tracks of a recording without times have no `begins`.
    if parts.keys() | {"begins"} == _TRACKS:
        return Tracks(**parts)
    if "corner" in parts:
        return Place(**{name: array.tolist() for name, array in parts.items()})
    return {name: int(part) for name, part in parts.items()}


def _check_tracks(tracks: Tracks, num_cells: int) -> None:
    """Refuse tracks with indices outside their arrays or the grid.

    Raises:
        ValueError: they do.
    """
    begins, first, count = tracks.begins, tracks.first, len(tracks.exits)
    whole_numbers = [tracks.cells, first, *([] if begins is None else [begins])]
    fine = all(each.dtype == np.int64 for each in whole_numbers) and tracks.exits.dtype == bool
    fine = fine and len(first) == count + 1 == len(tracks.names) + 1 > 1
    fine = fine and bool((tracks.lengths > 0).all())
    fine = fine and first[0] == 0 and first[-1] == len(tracks.cells)
    if begins is not None:
        fine = fine and begins.shape == (count,) and bool((begins >= 0).all())
    if not fine or not ((tracks.cells >= 0) & (tracks.cells < num_cells)).all():
        raise ValueError(f"tracks that do not follow each other on a grid of {num_cells} cells")


def refuse_given(*_: object, **__: object) -> Subject:
    """The maker of `kernel=given` and `sensor=given`, which describe a problem that is in a file.

    Raises:
        UserError: always.
    """
    raise UserError(f"kernel=given: the problem is in the run's {PROBLEM}; expected another kernel")
