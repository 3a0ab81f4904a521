"""Steps of several targets as messages: numbers of all in one, and for viewers beliefs and places of each.

`/grid` has how many targets are expected in each cell, `/belief/K` where target K is, in the smallest rectangle around
it, and `/targets` a disc for each target in a colour of its own, with its number; it is faint where the target was
missed.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from scipy import sparse

from trackmdp.episodes.episode import Episode
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
from trackmdp.episodes.messages import Form
from trackmdp.episodes.schema import belief_topic, clock_of, json_bytes
from trackmdp.episodes.target_colours import shares_of
from trackmdp.world.group import Group
from trackmdp.world.problem import Problem

_BELIEF = np.dtype([("belief", "<f4")])
_SAYS, _ACTIVE_SAYS = constant(_BELIEF), constant(ACTIVE)
_ABOVE, _UPRIGHT = 0.02, {"x": 0, "y": 0, "z": 0, "w": 1}
_WHITE = {"r": 1, "g": 1, "b": 1, "a": 1}
_FAINT = 0.4
"""Opacity of a target that was missed."""


def form_of(problem: Problem | Group) -> Form:
    """The form of the episodes of a log, of one target or of several; see `Form`."""
    return (GroupForm if problem.targets else Form)(problem)


class GroupForm(Form):
    """The form of the episodes of several targets."""

    @property
    def read_layers(self) -> Sequence[str]:
        """See `Form`."""
        return [belief_topic(target) for target in range(len(self.problem.targets))]

    def layers(self, episode: Episode, first_tick: int) -> Iterator[dict[str, bytes]]:
        """See `Form`."""
        (rows, columns), targets = self.task.size, len(episode.start)
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

    def _scene(self, episode: Episode, t: int, tick: int) -> bytes:
        """The targets that are in the grid, in place of those of the step before."""
        rows, columns = self.task.size
        time, entities = clock_of(tick), []
        for k in np.flatnonzero(episode.target[t] < self.task.num_cells).tolist():
            row, column = divmod(int(episode.target[t, k]), columns)
            place = {"x": column + 0.5, "y": rows - row - 0.5}
            colour = dict(zip("rgb", shares_of(k), strict=True))
            colour["a"] = 1 if episode.located[t, k] else _FAINT
            size = {"x": 0.6, "y": 0.6, "z": 0.01}
            disc = _at(place, _ABOVE, size=size, bottom_scale=1, top_scale=1, color=colour)
            own = {"billboard": True, "font_size": 0.4, "scale_invariant": False, "color": _WHITE}
            text = _at(place, 2 * _ABOVE, **own, text=str(k))
            entity = {"timestamp": time, "frame_id": "grid", "id": f"target {k}"}
            entities.append(entity | {"cylinders": [disc], "texts": [text]})
        everything = {"timestamp": time, "type": 1, "id": ""}
        return json_bytes({"deletions": [everything], "entities": entities})

    def _beliefs(self, mine: dict[str, list[bytes]]) -> dict[str, Any]:
        """See `Form`: `[T · K, M]` of the messages of each target."""
        task, topics = self.task, self.read_layers
        places = np.arange(task.num_cells).reshape(task.size)
        rows, columns, masses = [], [], []
        for k, topic in enumerate(topics):
            for t, text in enumerate(mine[topic]):
                part, cells = read_grid(text, task.size, _BELIEF)
                mass, cell = cells["belief"].ravel(), places[part].ravel()
                some = np.flatnonzero(mass)
                rows.append(np.full(len(some), t * len(topics) + k))
                columns.append(cell[some])
                masses.append(mass[some])
        entries = np.concatenate(masses), (np.concatenate(rows), np.concatenate(columns))
        steps = len(mine[topics[0]])
        return {"belief": sparse.csr_array(entries, shape=(steps * len(topics), task.num_cells))}


def _at(place: Mapping[str, float], height: float, **more: Any) -> dict[str, Any]:
    """A part of an entity in a place of the grid, upright."""
    return {"pose": {"position": {**place, "z": height}, "orientation": _UPRIGHT}, **more}
