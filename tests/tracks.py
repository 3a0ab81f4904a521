"""Recorded tracks for tests: by hand, or drawn from a kernel."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy import sparse

from trackmdp.recordings.tracks import Recorded, Tracks


def digest_of(tracks: Tracks) -> str:
    """SHA-256 of all that was recorded."""
    digest = hashlib.sha256()
    for part in (tracks.cells, tracks.first, tracks.exits, tracks.names):
        digest.update(np.ascontiguousarray(part).tobytes())
    return digest.hexdigest()


def by_hand(*tracks: Sequence[int], exits: bool | Sequence[bool] = True) -> Tracks:
    """The tracks as they are written, called 0, 1, 2 ..."""
    cells = np.concatenate([np.asarray(track, dtype=np.int64) for track in tracks])
    first = np.concatenate([[0], np.cumsum([len(track) for track in tracks])])
    return Tracks(cells, first, np.broadcast_to(exits, len(tracks)).copy(), np.arange(len(tracks)))


def drawn(kernel: sparse.csr_array, count: int, seed: int = 0) -> Tracks:
    """`count` tracks of a target that starts uniformly and moves as `kernel` says, to its exit."""
    rng, m = np.random.default_rng(seed), kernel.shape[0]
    edges = np.cumsum(kernel.toarray(), axis=1)
    at = [rng.integers(m, size=count)]
    while (at[-1] < m).any():
        here = at[-1].clip(max=m - 1)
        step = (rng.random(count)[:, None] > edges[here]).sum(axis=1)
        at.append(np.where(at[-1] < m, step, m))
    cells = np.stack(at, axis=1)
    lengths = (cells < m).sum(axis=1)
    return Tracks(
        cells[cells < m],
        np.concatenate([[0], np.cumsum(lengths)]),
        np.ones(count, bool),
        np.arange(count),
    )


def recorded(
    tracks: Tracks,
    held_out: Tracks | None = None,
    *,
    validation: Tracks | None = None,
    size: int = 3,
    t_max: int = 1,
    **more: Any,
) -> Recorded:
    """A task on tracks; r = 1, c = 0.2, D = 0.2 M; the other parts are the same tracks unless given."""
    of_task = {"cost": 0.2, "safe_cost": 0.2 * size**2, "t_max": t_max}
    parts = {"validation": validation or tracks, "held_out": held_out or tracks}
    return Recorded(tracks, size, **parts, **of_task, **more)


def write(file: Path, tracks: Tracks, *, size: int | None = None, step: bool = True) -> Path:
    """The tracks as a .csv; with `size`, in rows and columns."""
    track = np.repeat(tracks.names, tracks.lengths)
    number = np.arange(len(tracks.cells)) - np.repeat(tracks.first[:-1], tracks.lengths)
    columns = {"track": track} | ({"step": number} if step else {})
    if size is None:
        columns["cell"] = tracks.cells
    else:
        columns |= {"row": tracks.cells // size, "column": tracks.cells % size}
    np.savetxt(
        file,
        np.stack(list(columns.values()), axis=1),
        fmt="%d",
        delimiter=",",
        header=",".join(columns),
        comments="",
    )
    return file
