"""The targets of an environment or a simulation: where they go, and the generators of their starts and moves.

They go by draws of the kernel (`Motion`), or along recorded tracks. A place, int64, is the full state of a target: its
cell, the cell and the mode, or a point of a track.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
import torch
from scipy import sparse
from torch import Tensor

from trackmdp.errors import UserError
from trackmdp.seeding import generator
from trackmdp.world.draws import Draw, Streams
from trackmdp.world.modes import HiddenWorld
from trackmdp.world.tracks import Problem, Recorded, Tracks

_RESOLUTION = 2**40
"""Draws are multiples of 2^-40; no successor is more or less likely than in the kernel by more than that."""

_SHORT = 32
"""Entries of a row up to which its edges are compared one by one."""

_MOST_CELLS = 2**23 - 2
"""(M + 1) · 2^40, the end of the line, must be an int64."""


class Motion:
    """Samples x_{k+1} ~ P(x_k, ·) for a batch of targets.

    The rows of the kernel, each closed by the exit, lie end to end on one line of whole numbers: cell x owns
    [x · 2^40, (x + 1) · 2^40), and of it each successor the share that is its probability. One binary search of
    x · 2^40 + u · 2^40 therefore finds the successor, whatever the support of the row; being a search among integers it
    is exact for every cell of a large grid. The exit is cell number M, and stays there.

    With H modes what is said of cells holds for places, cell · H + mode; all of them are starts.

    Args:
        kernel: `[M, M]`, or with modes `[M · H, M · H]`.
        device: where the tensors live.
        modes: H.

    Attributes:
        starts: how many places to start in there are.
    """

    def __init__(self, kernel: sparse.csr_array, device: torch.device | str = "cpu", modes: int = 1) -> None:
        m = kernel.shape[0]
        self.starts, self.device, self._modes = m, torch.device(device), modes
        if m > _MOST_CELLS:
            raise UserError(f"kernel: {m:,} cells, expected at most {_MOST_CELLS:,}")
        # Worked example, two cells, in units of 2^40: P_01 = .5, P_10 = .25, P_11 = .5. The ends within the rows are .5
        # and .25, .75; shifted by the cell and closed by the exit at 1 and 2, and by the exited target's own stretch at
        # 3, the line is edges .5 1 1.25 1.75 2 3 with successors 1 M 0 1 M M.
        ends = _running_sums(kernel)
        # A successor whose share ends at e is drawn for u < e. With u = k / 2^40 that is k < ceil(e · 2^40), exactly.
        edges = np.ceil(np.minimum(ends, 1.0) * _RESOLUTION).astype(np.int64)
        # What is left of 1 is the exit's. A row that reaches 1, up to rounding, leaves nothing.
        # after[x] is the end of cell x's stretch; `insert` puts it behind the row's own edges, at indptr[x + 1].
        after = np.arange(1, m + 1, dtype=np.int64) * _RESOLUTION
        edges += np.repeat(after - _RESOLUTION, np.diff(kernel.indptr))
        closed = np.append(np.insert(edges, kernel.indptr[1:], after), (m + 1) * _RESOLUTION)
        successors = np.append(np.insert(kernel.indices.astype(np.int64), kernel.indptr[1:], m), m)
        self._edges = torch.as_tensor(closed, device=device)
        self._successors = torch.as_tensor(successors, device=device)
        # Each row has one edge more than entries, so that x's begin at indptr[x] + x; M's is the last of all.
        self._first = torch.as_tensor(kernel.indptr.astype(np.int64) + np.arange(m + 1), device=device)
        width = int(np.diff(kernel.indptr).max(initial=0))
        self._within = torch.arange(width, device=device)[:, None] if 0 < width <= _SHORT else None

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """`[count]` float64 uniform draws for `move`."""
        # Whole numbers over 2^40 are exact in float64 (53 bits), so `move` gets back the very integer that was drawn.
        draws = torch.randint(_RESOLUTION, (count,), generator=generator, device=self._edges.device)
        return draws.double() / _RESOLUTION

    def move(self, cells: Tensor, draws: Tensor) -> Tensor:
        """`[B]` next cells of the targets at `cells` `[B]` under uniform `draws` `[B]`; M means exited."""
        # The first edge beyond x + u: from cell 0, u = .3 finds edge .5 (to cell 1) and u = .7 finds 1 (exit).
        # right=True, since an edge is the first draw that no longer belongs to its successor.
        place = (draws * _RESOLUTION).long().add_(cells, alpha=_RESOLUTION)
        if self._within is not None:
            # Of a short row every edge is compared, which reads far less than a search in the edges of a large grid.
            # Edges of later rows, beyond x + u, are not counted, and no row has more below x + u than entries.
            first = self._first.index_select(0, cells)
            near = (first + self._within).clamp_max_(len(self._edges) - 1)
            passed = self._edges.index_select(0, near.view(-1)).view(near.shape) <= place
            return self._successors.index_select(0, first.add_(passed.sum(0)))
        return self._successors[torch.searchsorted(self._edges, place, right=True)]

    def begin(self, numbers: Tensor) -> Tensor:
        """`[B]` places of the starts `numbers` `[B]`."""
        return numbers

    def cell(self, place: Tensor) -> Tensor:
        """`[B]` cells; M for a target that has exited, which is in the place behind all others."""
        return place if self._modes == 1 else place // self._modes

    def mode(self, place: Tensor) -> Tensor | None:
        """`[B]` modes, -1 for a target that has exited; None where targets have none."""
        return None if self._modes == 1 else torch.where(place < self.starts, place % self._modes, -1)

    def stops(self, place: Tensor) -> Tensor | None:  # noqa: ARG002
        """`[B]` bool, whether the recording stops here with the target still in the grid; None if it never does."""
        return None


def _running_sums(kernel: sparse.csr_array) -> npt.NDArray[np.float64]:
    """`[nnz]` for each entry the sum of its row up to and with it, added from left to right."""
    sums, lengths = kernel.data.astype(np.float64), np.diff(kernel.indptr)
    # One pass for each place in a row: a running sum over all entries at once would round differently in each row.
    for place in range(1, int(lengths.max(initial=0))):
        entry = kernel.indptr[:-1][lengths > place] + place
        sums[entry] += sums[entry - 1]
    return sums


class Replayed:
    """Targets that go along recorded tracks; methods as those of `Motion`.

    A place is a point of the line that all tracks, each closed by the exit, form end to end. Starts are the first cells
    of the tracks, or with `anywhere` all recorded points.
    """

    def __init__(self, tracks: Tracks, num_cells: int, device: torch.device, *, anywhere: bool = False) -> None:
        # Track 3 4, which exits, and track 7 8, which stops: cells 3 4 M 7 8, following 1 2 2 4 4 (the last point of a
        # track stays where it is), stops at point 4, starts 0 and 3. With `anywhere` episodes may start at 0, 1 and 3:
        # neither at an exit, nor where no next step is known.
        line = tracks.closed(num_cells)
        last, following = line.first[1:] - 1, np.arange(len(line.cells)) + 1
        following[last] = last
        stops = np.zeros(len(line.cells), dtype=bool)
        stops[last] = ~tracks.exits
        begins = np.flatnonzero((line.cells < num_cells) & ~stops) if anywhere else line.first[:-1]
        self.starts, self.device = len(begins), device
        self._cells, self._following, self._begins, self._stops = (
            torch.as_tensor(part, device=device) for part in (line.cells, following, begins, stops)
        )

    def begin(self, numbers: Tensor) -> Tensor:
        """See `Motion`."""
        return self._begins[numbers]

    def draw(self, count: int, generator: torch.Generator) -> Tensor:  # noqa: ARG002
        """See `Motion`."""
        return torch.zeros(count, dtype=torch.float64, device=self.device)  # a recorded path needs none

    def move(self, place: Tensor, draws: Tensor) -> Tensor:  # noqa: ARG002
        """See `Motion`."""
        return self._following[place]

    def cell(self, place: Tensor) -> Tensor:
        """See `Motion`."""
        return self._cells[place]

    def mode(self, place: Tensor) -> None:
        """See `Motion`."""

    def stops(self, place: Tensor) -> Tensor:
        """See `Motion`."""
        return self._stops[place]


Source: TypeAlias = Motion | Replayed


def held_out_source(problem: Problem) -> Source:
    """What a policy is judged by: the motion of a world, or the held-out ones of recorded tracks."""
    if isinstance(problem, Recorded):
        return Replayed(problem.held_out, problem.num_cells, torch.device("cpu"))
    return Motion(problem.kernel, modes=problem.modes if isinstance(problem, HiddenWorld) else 1)


class Targets(Streams):
    """A batch of targets that start uniformly over the places, and move as the kernel says.

    Their places are in the environment's state; this object holds only the generators.

    Args:
        source: where they go.
        key: under which name the environment keeps their places; "target", the cell, where the two are the same.

    Attributes:
        draw: gives the random numbers for the next move of the targets of a mask `[B]`.
    """

    def __init__(self, source: Source, key: str) -> None:
        super().__init__(source.device, "motion", "start")
        self.source, self._key = source, key
        self._starts = Draw(self._start_of, torch.int64, source.device)
        self.draw = Draw(self._draw_of, torch.float64, source.device)

    def _start_of(self, rows: Tensor) -> Tensor:
        """`[B]` places of fresh targets, of which the mask `rows` `[B]` is used."""
        # For all rows, so that what a row gets does not depend on the others.
        rng, device = self.generators["start"], self.source.device
        return torch.randint(self.source.starts, rows.shape, generator=rng, device=device)

    def _draw_of(self, rows: Tensor) -> Tensor:
        """The random numbers for the next move of the targets `rows` `[B]`."""
        return self.source.draw(len(rows), self.generators["motion"])

    def start(self, rows: Tensor) -> dict[str, Tensor]:
        """`target`, and what else a move depends on, `[B]` of fresh targets, of which the mask `rows` `[B]` is used."""
        return self._known(self._starts(rows))

    def move(self, state: Mapping[str, Tensor], draws: Tensor) -> dict[str, Tensor]:
        """The same as of `start` after one move; a target of M has exited."""
        return self._known(self.source.move(state[self._key], draws))

    def mode(self, state: Mapping[str, Tensor]) -> Tensor | None:
        """`[B]` the targets' modes, -1 of one that has exited; None where they have none."""
        return self.source.mode(state[self._key])

    def cut(self, moved: Mapping[str, Tensor]) -> Tensor | None:
        """`[B]` whether the recording stops after this move (the episode is truncated); None if it never does."""
        return self.source.stops(moved[self._key])

    def _known(self, place: Tensor) -> dict[str, Tensor]:
        return {"target": self.source.cell(place), self._key: place}


class RecordedTargets(Targets):
    """Targets that go along recorded tracks; episodes begin at the starts in shuffled order, each once in a round.

    The e-th order of the starts comes from the generator called (`stream`, "tracks", e).
    """

    def seed(self, seed: int, stream: str) -> None:
        """See `Targets`."""
        self._names, self._drawn, self._orders = (seed, stream), 0, dict[int, Tensor]()

    def state(self) -> dict[str, Tensor]:
        """How many episodes have begun."""
        return {"drawn": torch.tensor(self._drawn, device="cpu")}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """See `Targets`."""
        self._drawn = int(state["drawn"])

    def _start_of(self, rows: Tensor) -> Tensor:
        wanted = rows.nonzero().squeeze(-1)
        place = wanted.new_zeros(len(rows))
        # Rows that are not wanted use up no start, or tracks would be left out; they stand at point 0, unused.
        place[wanted] = self.source.begin(self._next(len(wanted)))
        return place

    def _next(self, count: int) -> Tensor:
        """`[count]` numbers of starts, the next ones in order."""
        # 5 starts, 3 drawn so far, 4 wanted: rounds 0 and 1 are laid end to end and places 3 ... 6 taken. Only the
        # count is saved in a checkpoint; the orders follow from the seed.
        length, begin = self.source.starts, self._drawn
        self._drawn = end = begin + count
        first = begin // length
        # Rounds before the first one needed are dropped: at most a few orders are held.
        rounds = range(first, max(end - 1, begin) // length + 1)
        self._orders = {each: self._orders[each] if each in self._orders else self._order(each) for each in rounds}
        return torch.cat(list(self._orders.values()))[begin - first * length : end - first * length]

    def _order(self, number: int) -> Tensor:
        # On the CPU, whatever the default device is: there is one order for all devices.
        order = torch.randperm(self.source.starts, generator=generator(*self._names, "tracks", number), device="cpu")
        return order.to(self.source.device)

    def _draw_of(self, rows: Tensor) -> Tensor:
        return torch.zeros(rows.shape, dtype=torch.float64, device=rows.device)  # a recorded target's move is known


def make_targets(problem: Problem, device: torch.device) -> Targets:
    """The targets of a world or of recorded tracks."""
    if isinstance(problem, Recorded):
        return RecordedTargets(Replayed(problem.tracks, problem.num_cells, device, anywhere=problem.anywhere), "place")
    if isinstance(problem, HiddenWorld):
        return Targets(Motion(problem.kernel, device, problem.modes), "place")
    return Targets(Motion(problem.kernel, device), "target")
