"""Recorded tracks: the cells a target was in, step by step, from which a policy is learned without a motion model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Unpack

import numpy as np
from scipy import sparse

from trackmdp.arrays.entries import ends_of
from trackmdp.arrays.files import read_columns
from trackmdp.arrays.types import Array, BoolArray, Indices
from trackmdp.errors import UserError
from trackmdp.grid.size import Size, grid_size
from trackmdp.motion.chain import Motion
from trackmdp.notebook.card import Facts
from trackmdp.seeding import derive
from trackmdp.sensing.task import Task, TaskOptions

_COLUMNS = ({"track", "cell"}, {"track", "row", "column"})
_FORMAT = "track, cell (or row, column) and, if wanted, step"


@dataclass(frozen=True, eq=False)
class Tracks:
    """K recorded tracks, end to end.

    Attributes:
        cells: `[P]`, the cells of all tracks, one track after the other.
        first: `[K + 1]`, where each track begins in `cells`, and P.
        exits: `[K]`, whether the target left the grid after the last cell; if not, the recording stopped there.
        names: `[K]`, the id of each track.
        begins: `[K]`, the step of the recording's clock at which each begins, from 0; None: all at once.
    """

    cells: Indices
    first: Indices
    exits: BoolArray
    names: Indices
    begins: Indices | None = None

    def __len__(self) -> int:
        return len(self.exits)

    @property
    def lengths(self) -> Indices:
        """`[K]` cells of each track."""
        return np.diff(self.first)

    @property
    def places(self) -> Indices:
        """`[P]`, place of each point in its own track: tracks of 3 and 2 cells count 0 1 2 0 1."""
        return np.arange(len(self.cells)) - np.repeat(self.first[:-1], self.lengths)

    def select(self, chosen: BoolArray) -> Tracks:
        """The tracks for which `chosen` `[K]` holds."""
        lengths = self.lengths
        cells = self.cells[np.repeat(chosen, lengths)]
        begins = None if self.begins is None else self.begins[chosen]
        return Tracks(
            cells, ends_of(lengths[chosen]), self.exits[chosen], self.names[chosen], begins
        )

    def pieces(self) -> list[bytes]:
        """The cells of each track as bytes: NumPy takes ten times as long to split an array."""
        cells, ends = self.cells.tobytes(), (self.first * self.cells.itemsize).tolist()
        return [cells[begin:end] for begin, end in pairwise(ends)]

    def limited(self, max_steps: int | None) -> Tracks:
        """The tracks, cut off after `max_steps` steps; None for never."""
        if max_steps is None:
            return self
        lengths = self.lengths
        # max_steps moves have max_steps + 1 cells. A track cut short has no exit any more; one of max_steps + 1 cells
        # leaves on a step too many.
        kept = np.minimum(lengths, max_steps + 1)
        cells, exits = self.cells[self.places <= max_steps], self.exits & (lengths <= max_steps)
        return replace(self, cells=cells, first=ends_of(kept), exits=exits)

    def closed(self, num_cells: int) -> Tracks:
        """The tracks with the exit, a cell called M, as the last one where the target left."""
        # np.insert takes places in the old array: M goes before the first cell of the next track.
        cells = np.insert(self.cells, self.first[1:][self.exits], num_cells)
        return replace(self, cells=cells, first=ends_of(self.lengths + self.exits))

    def steps(self, num_cells: int) -> tuple[Indices, Indices]:
        """Cells before and after every step, `[K]` each; M after an exit."""
        # Example: the tracks 3 4 (exit) and 7 8 stand end to end as cells = 3 4 M 7 8 with first = 0 3 5. Every place
        # but a track's last one (2 and 4) begins a step: 3 to 4, 4 to M, 7 to 8.
        line = self.closed(num_cells)
        begins = np.ones(len(line.cells), bool)
        begins[line.first[1:] - 1] = False
        at = np.flatnonzero(begins)
        return line.cells[at], line.cells[at + 1]

    def kernel(self, num_cells: int) -> sparse.csr_array:
        """`[M, M]` shares of the moves out of each cell; one more move of each counts as an exit."""
        start, end = self.steps(num_cells)
        moved = sparse.coo_array(
            (np.ones(len(start)), (start, end)), shape=(num_cells, num_cells + 1)
        )
        seen = np.bincount(start, minlength=num_cells)
        share = sparse.diags_array(1.0 / (seen + 1.0)) @ sparse.csr_array(moved)
        return share[:, :num_cells]

    def motion(self, *, anywhere: bool = False) -> Motion:
        """The tracks as a chain of their P points, each followed by the next one with probability 1.

        Episodes start with a track, or with `anywhere` at any point that has a next step.
        """
        # Track 3 4, which exits, and track 7 8, which stops: points 0 1 2 3, moves from 0 to 1 and from 2 to 3. Point 1
        # has none, so that the target exits; point 3 has none either, but the recording stops there.
        points, last = len(self.cells), self.first[1:] - 1
        goes_on = np.ones(points, bool)
        goes_on[last] = False
        ends = np.zeros(points, bool)
        ends[last] = ~self.exits
        count = ends_of(goes_on.astype(np.int64))
        moves = sparse.csr_array(
            (np.ones(count[-1]), np.flatnonzero(goes_on) + 1, count), shape=(points, points)
        )
        first = np.flatnonzero(~ends) if anywhere else self.first[:-1]
        return Motion(moves, self.cells, first, goes_on.astype(np.float64), ends=ends)


@dataclass(frozen=True, eq=False, init=False, repr=False)
class Recorded(Task):
    """A task with recorded tracks in place of a motion model; `load_tracks` makes one of a file.

    Args:
        size: N of an N x N grid, or (rows, columns).
        **of_task: as of `World`.

    Attributes:
        tracks: those to learn from.
        validation: those to choose between policies by (best.pt, Optuna's trials); nothing learns from them.
        held_out: tracks to evaluate on at the end; no learner and no choice sees them.
        anywhere: episodes to learn from begin at any recorded point, not only with a track; None: where `max_steps`
            cuts them, since what comes later would not be learned from.
        loaded: counts of positions and tracks read, cut and dropped on the way from positions to the grid.
    """

    tracks: Tracks
    validation: Tracks
    held_out: Tracks
    anywhere: bool | None
    loaded: Mapping[str, int]

    def __init__(
        self,
        tracks: Tracks,
        size: Size,
        *,
        validation: Tracks,
        held_out: Tracks,
        anywhere: bool | None = None,
        loaded: Mapping[str, int] | None = None,
        **of_task: Unpack[TaskOptions],
    ) -> None:
        super().__init__(size, **of_task)  # type: ignore[arg-type]  # as in `World`
        own: dict[str, object] = {"tracks": tracks, "validation": validation, "held_out": held_out}
        own |= {"anywhere": anywhere, "loaded": loaded or {}}
        for name, value in own.items():
            object.__setattr__(self, name, value)  # the dataclass is frozen

    def facts(self) -> Facts:
        """The figures of the card, those of the recording among them."""
        parts = {"to learn from": self.tracks, "to choose by": self.validation}
        parts["held out"] = self.held_out
        counts = ", ".join(f"{len(part):,} {name}" for name, part in parts.items())
        points = sum(len(part.cells) for part in parts.values())
        begin = "at any point of a track" if self._anywhere else "with a track"
        recording = {"tracks": counts, "points": f"{points:,}; episodes begin {begin}"}
        return super().facts() | recording

    @property
    def _anywhere(self) -> bool:
        return self.max_steps is not None if self.anywhere is None else self.anywhere

    @property
    def model(self) -> None:
        """No motion model."""

    @property
    def recorded(self) -> Recorded:
        """The tracks themselves; of a world None."""
        return self

    @property
    def motion(self) -> Motion:
        """The held-out tracks, on which policies are valued, cut off after `max_steps`."""
        return self.held_out.limited(self.max_steps).motion()

    def sampled(self, *, held_out: bool = False) -> Motion:
        """The tracks that targets follow: those to learn from, or on request the held-out ones, uncut."""
        if held_out:
            return self.held_out.motion()
        return self.tracks.motion(anywhere=self._anywhere)

    @property
    def selection(self) -> Recorded:
        """The same task, evaluated on the validation tracks in place of the held-out ones."""
        return replace(self, held_out=self.validation)


def read_tracks(path: str | Path, size: Size, exits: bool, shortest: int = 1) -> Tracks:
    """Read tracks from a .csv file with a header line, or from arrays of the same names in an .npz file.

    The columns are `track` (an integer or a text, the same for all steps of a track; texts are numbered in sorted
    order), `cell` (or `row` and `column`), and if wanted `step`. Without `step` a track's cells are in the order of the
    file.

    Args:
        path: the file.
        size: of the grid, one number for a square.
        exits: whether the target left the grid at the end of each track.
        shortest: fewest cells of a track.

    Raises:
        UserError: the file is not of that form, a cell lies outside the grid, a step is missing or there twice, or a
            track is too short.
    """
    source, (columns, texts) = f"kernel.path={path}", read_columns("kernel.path", path, ids="track")
    if set(columns) - {"step"} not in _COLUMNS:
        raise UserError(f"{source}: columns {', '.join(columns) or 'none'}, expected {_FORMAT}")
    if not len(columns["track"]):
        raise UserError(f"{source}: no tracks, expected at least two")
    numbers = {name: _integers(source, name, column) for name, column in columns.items()}
    track, cell = numbers["track"], _cells(source, numbers, grid_size(size))
    # Last key first: by track, then by step. Without steps the sort is stable, so that the file's order stays.
    order = np.lexsort((numbers.get("step", np.zeros_like(track)), track))
    track, cell = track[order], cell[order]
    names, lengths = np.unique(track, return_counts=True)
    first, begins = ends_of(lengths), None
    if "step" in numbers:
        step = numbers["step"][order]
        _check_steps(source, track, step, texts)
        begins = step[first[:-1]] - step.min()
    short = np.flatnonzero(lengths < shortest)
    if len(short):
        name = texts[short[0]] if texts else names[short[0]]
        raise UserError(
            f"{source}: track {name} has {lengths[short[0]]} cells, expected at least {shortest} "
            f"({len(short)} of {len(names)} are too short)"
        )
    return Tracks(cell, first, np.full(len(names), exits), names, begins)


def split(
    tracks: Tracks, held_out: float, validation: float, seed: int, *, names: Indices | None = None
) -> tuple[Tracks, Tracks, Tracks]:
    """Three parts drawn at random: to learn from, to choose between policies by, and held out for the last figures.

    Tracks of one name stay together: the pieces of one target's path are alike, and a piece in one part would be
    information about the others.

    Args:
        tracks: all of them.
        held_out: as of `draw_names`, like the following.
        validation: see `held_out`.
        seed: see `held_out`.
        names: of the targets that the parts are drawn from, also those without a track here; None: of the tracks.

    Raises:
        UserError: one of the three parts is empty.
    """
    own = tracks.names
    drawings = draw_names(own if names is None else names, held_out, validation, seed)
    judged, chosen = (np.isin(own, each) for each in drawings)
    learned = ~(judged | chosen)
    counts = int(judged.sum()), int(chosen.sum()), int(learned.sum())
    _check_parts(counts, held_out, validation)
    return tracks.select(learned), tracks.select(chosen), tracks.select(judged)


def draw_names(
    names: Indices, held_out: float, validation: float, seed: int
) -> tuple[Indices, Indices]:
    """The names of targets to hold out and of those to choose between policies by, drawn at random.

    Args:
        names: of all targets; repeated ones count once.
        held_out: about this share of the names is held out; which ones does not depend on `validation`.
        validation: share of the names to choose by.
        seed: of the draw.

    Raises:
        UserError: one of the two is empty, or no name is left to learn from.
    """
    order = shuffled(names, derive(seed, "held_out"))
    last, middle = (round(share * len(order)) for share in (held_out, validation))
    _check_parts((last, middle, len(order) - last - middle), held_out, validation)
    return order[:last], order[last : last + middle]


def _check_parts(counts: tuple[int, int, int], held_out: float, validation: float) -> None:
    for count, words in zip(counts, ("judge on", "choose by", "learn from"), strict=True):
        if count < 1:
            raise UserError(
                f"kernel.held_out={held_out}, kernel.validation={validation}: leave, of {sum(counts)} tracks, none to "
                f"{words}; expected at least one for each"
            )


def shuffled(names: Indices, seed: int) -> Indices:
    """The names, each once, in a random order."""
    names = np.unique(names)
    return names[np.random.default_rng(seed).permutation(len(names))]


def _integers(source: str, name: str, column: Array) -> Indices:
    # Beyond 2^53 float64 skips integers, and two ids could become one; ~(<) is True for nan as well.
    bad = ~(np.abs(column) < 2**53) | (column != np.floor(column))
    if bad.any():
        entry = int(np.flatnonzero(bad)[0])
        raise UserError(
            f"{source}: {name} of entry {entry + 1} is {column[entry]}, expected an integer"
        )
    return column.astype(np.int64)


def _cells(source: str, numbers: dict[str, Indices], size: tuple[int, int]) -> Indices:
    rows, columns = size
    limits = {"cell": rows * columns} if "cell" in numbers else {"row": rows, "column": columns}
    for name, limit in limits.items():
        outside = (numbers[name] < 0) | (numbers[name] >= limit)
        if outside.any():
            entry = int(np.flatnonzero(outside)[0])
            raise UserError(
                f"{source}: {name} of entry {entry + 1} is {numbers[name][entry]}, expected 0 to {limit - 1} on a "
                f"grid of {rows}x{columns} cells"
            )
    return numbers["cell"] if "cell" in numbers else numbers["row"] * columns + numbers["column"]


def _check_steps(source: str, track: Indices, step: Indices, texts: Sequence[str]) -> None:
    jump = np.diff(step)
    bad = (np.diff(track) == 0) & (jump != 1)
    if not bad.any():
        return
    at = int(np.flatnonzero(bad)[0])
    name = texts[track[at]] if texts else track[at]
    raise UserError(
        f"{source}: track {name}: step {step[at + 1]} follows step {step[at]}, expected {step[at] + 1}"
    )
