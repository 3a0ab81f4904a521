"""Steps of several targets as messages: numbers of all in one, and for viewers beliefs and places of each.

`/grid` has how many targets are expected in each cell, `/belief/K` where target K is, in the smallest rectangle around
it, and `/targets` a disc for each target in a colour of its own, with its number; it is faint where the target was
missed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from scipy import sparse

from trackmdp.episodes.grids import (
    ACTIVE,
    WHOLE_CELLS,
    boxed,
    boxes_of,
    constant,
    part_text,
    read_grid,
    stamp_of,
)
from trackmdp.episodes.group_episode import GroupEpisode
from trackmdp.episodes.messages import Form
from trackmdp.episodes.schema import LoggedRun, belief_topic, clock_of, json_bytes
from trackmdp.episodes.target_colours import shares_of
from trackmdp.sensing.coverage import Coverage

_BELIEF = np.dtype([("belief", "<f4")])
_SAYS, _ACTIVE_SAYS = constant(_BELIEF), constant(ACTIVE)
_ABOVE, _UPRIGHT = 0.02, {"x": 0, "y": 0, "z": 0, "w": 1}
_FAINT = 0.4
"""Opacity of a target that was missed."""


def form_of(run: LoggedRun, coverage: Coverage | None = None) -> Form:
    """The form of the episodes of a log, of one target or of several; see `Form`."""
    return (GroupForm if run.kinds else Form)(run, coverage)


class GroupForm(Form):
    """The form of the episodes of several targets."""

    @property
    def read_layers(self) -> Sequence[str]:
        """See `Form`."""
        return [belief_topic(target) for target in range(len(self.run.kinds))]

    def layers(self, episode: GroupEpisode, first_tick: int) -> Iterator[dict[str, bytes]]:
        """See `Form`."""
        (rows, columns), targets = self.run.size, len(episode.start)
        sensed = episode.action.reshape(-1, rows, columns)
        for t, active in enumerate(boxes_of(sensed)):
            stamp = stamp_of(first_tick + t)
            each = episode.belief[t * targets : (t + 1) * targets].toarray()
            # From the numbers that are logged, so that a log written anew has the same bytes.
            every = each.sum(axis=0, dtype=np.float64).astype(np.float32)
            beliefs = np.concatenate([every[None], each]).reshape(-1, rows, columns)
            used = beliefs > 0
            used[0] |= rows * columns <= WHOLE_CELLS
            topics = ["/grid", *self.read_layers]
            drawn = zip(topics, beliefs.view(_BELIEF), boxes_of(used), strict=True)
            said = {topic: boxed(stamp, _SAYS, cells, box, 0) for topic, cells, box in drawn}
            said["/active"] = boxed(stamp, _ACTIVE_SAYS, sensed[t].view(np.uint8), active, 0.01)
            said["/targets"] = self._scene(episode, t, first_tick + t)
            yield said | {"/part": part_text(stamp, columns / 2, rows / 2)}

    def _scene(self, episode: GroupEpisode, t: int, tick: int) -> bytes:
        """The targets that are in the grid, in place of those of the step before."""
        rows, columns = self.run.size
        time, entities = clock_of(tick), []
        for k in np.flatnonzero(episode.target[t] < self.run.cells).tolist():
            row, column = divmod(int(episode.target[t, k]), columns)
            place = {"x": column + 0.5, "y": rows - row - 0.5}
            colour = dict(zip("rgb", shares_of(k), strict=True))
            disc: dict[str, Any] = {
                "pose": {"position": place | {"z": _ABOVE}, "orientation": _UPRIGHT}
            }
            disc |= {"size": {"x": 0.6, "y": 0.6, "z": 0.01}, "bottom_scale": 1, "top_scale": 1}
            disc |= {"color": colour | {"a": 1 if episode.located[t, k] else _FAINT}}
            text: dict[str, Any] = {
                "pose": {"position": place | {"z": 2 * _ABOVE}, "orientation": _UPRIGHT}
            }
            text |= {"billboard": True, "font_size": 0.4, "scale_invariant": False}
            text |= {"color": {"r": 1, "g": 1, "b": 1, "a": 1}, "text": str(k)}
            entity = {"timestamp": time, "frame_id": "grid", "id": f"target {k}"}
            entities.append(entity | {"cylinders": [disc], "texts": [text]})
        everything = {"timestamp": time, "type": 1, "id": ""}
        return json_bytes({"deletions": [everything], "entities": entities})

    def _episode(
        self, row: dict[str, Any], said: list[dict[str, Any]], mine: dict[str, list[bytes]]
    ) -> GroupEpisode:
        """See `Form`."""
        found, targets = self._common(row, said), len(self.run.kinds)
        shape = len(said), targets
        if any(found[name].shape != shape for name in ("misses", "target", "located")):
            raise ValueError(f"steps of other than {targets} targets")
        start = np.array(row["start"], dtype=np.int64)
        if start.shape != (targets,):
            raise ValueError(f"starts of other than {targets} targets")
        start = np.where(start < 0, self.run.cells, start)
        return GroupEpisode(**found, start=start, belief=self._belief(mine, len(said)))

    def _belief(self, mine: dict[str, list[bytes]], steps: int) -> sparse.csr_array:
        """`[T · K, M]` of the messages of each target."""
        run, topics = self.run, self.read_layers
        places = np.arange(run.cells).reshape(run.size)
        rows, columns, masses = [], [], []
        for k, topic in enumerate(topics):
            for t, text in enumerate(mine[topic]):
                part, cells = read_grid(text, run.size, _BELIEF)
                mass, cell = cells["belief"].ravel(), places[part].ravel()
                some = np.flatnonzero(mass)
                rows.append(np.full(len(some), t * len(topics) + k))
                columns.append(cell[some])
                masses.append(mass[some])
        entries = np.concatenate(masses), (np.concatenate(rows), np.concatenate(columns))
        return sparse.csr_array(entries, shape=(steps * len(topics), run.cells))
