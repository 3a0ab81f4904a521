"""Episodes as messages, and read back from them: the form of the episodes of a log.

Of several targets, numbers of all are in one message. For viewers, `/grid` has how many targets are expected in each
cell, `/belief/K` where target K is, in the smallest rectangle around it, and `/targets` a disc for each target in a
colour of its own, with its number; it is faint where the target was missed.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from scipy import sparse

from trackmdp.episodes.container import Said
from trackmdp.episodes.episode import Episode
from trackmdp.episodes.grids import (
    ACTIVE,
    WHOLE_CELLS,
    boxed,
    boxes_of,
    grid_messages,
    part_text,
    read_grid,
    read_grids,
    stamp_of,
)
from trackmdp.episodes.schema import (
    belief_topic,
    clock_of,
    json_bytes,
    modes_of,
    tick_of,
    time_of,
)
from trackmdp.episodes.target_colours import shares_of
from trackmdp.errors import UserError
from trackmdp.world.group import Subject

_BELIEF = np.dtype([("belief", "<f4")])
_ABOVE, _UPRIGHT = 0.02, {"x": 0, "y": 0, "z": 0, "w": 1}
_WHITE = {"r": 1, "g": 1, "b": 1, "a": 1}
_HUGE = np.finfo(np.float32).max
_FAINT = 0.4
"""Opacity of a target that was missed."""


class Form:
    """The form of the episodes of one target; see `GroupForm` for several.

    Args:
        problem: where the episodes took place.
    """

    def __init__(self, problem: Subject) -> None:
        self.problem, self.task = problem, problem.single

    @property
    def read_layers(self) -> Sequence[str]:
        """Topics of the layers that an episode is read from."""
        return ("/grid",)

    def row(self, episode: Any, first_tick: int) -> dict[str, Any]:
        """The `/episode` message."""
        modal = episode.mode is not None
        of_mode = {"start_mode": np.asarray(episode.start_mode).tolist()} if modal else {}
        return {
            **of_mode,
            "episode": episode.number,
            # Seeds have 63 bits and times in ns 60: as JSON numbers, a viewer in JavaScript would round them, which it
            # does beyond 2^53.
            "seed": str(episode.seed),
            "policy": episode.policy,
            "start": self._written(episode.start).tolist(),
            "length": len(episode),
            "return": float(episode.returns[-1]),
            "detections": int(episode.located.sum()),
            "forced": int(episode.forced(self.task.t_max).sum()),
            "terminated": episode.terminated,
            "truncated": episode.truncated,
            "start_time": str(time_of(first_tick)),
            "end_time": str(time_of(first_tick + len(episode) - 1)),
        }

    def steps(self, episode: Episode) -> Iterator[bytes]:
        """The `/step` messages; of several targets with a number of each in the place of one."""
        (rows, columns), t = self.task.size, np.arange(len(episode))
        there = episode.target < self.task.num_cells
        steps, ids = np.nonzero(episode.action)
        # np.nonzero lists (step, sensor) in order of steps: steps 0 0 1 3 with sensors 2 5 4 0. searchsorted finds
        # where steps 1, 2, 3 begin, 2 3 3, and split makes of those [2 5] [4] [] [0].
        active = [each.tolist() for each in np.split(ids, np.searchsorted(steps, t[1:]))]
        inside = {"n_present": there.sum(axis=1)} if episode.several else {}
        forced = episode.forced(self.task.t_max)
        said: dict[str, Any] = {
            "episode": np.full(len(episode), episode.number),
            "t": t,
            "n": episode.misses,
            "last_cell": self._written(episode.last_cell),
            "active": active,
            "n_active": episode.action.sum(axis=1) * ~forced,
            "forced": forced,
            "target": self._written(episode.target),
            "target_x": np.where(there, episode.target % columns, -1),
            # Cells are numbered from the top left, a plot's y axis points upwards: in 3 rows of 4, cell 5 is at x = 1,
            # y = 1, cell 0 at x = 0, y = 2.
            "target_y": np.where(there, rows - 1 - episode.target // columns, -1),
            "obs": episode.observation,
            **inside,
            "reward": episode.reward.astype(np.float64),
            "ep_return": episode.returns,
            "first": t == 0,
            "last": t == t[-1],
            **({} if episode.mode is None else {"mode": episode.mode}),
        }
        # tolist() once for each column: Python's numbers are written several times faster than NumPy's scalars.
        lists = (each if each is active else each.tolist() for each in said.values())
        for values in zip(*lists, strict=True):
            yield json_bytes(dict(zip(said, values, strict=True)))

    def _written(self, cells: Any) -> Any:
        """Cells with -1 for none, which is M in an episode: a schema with null is refused by viewers, topic and all."""
        return np.where(cells == self.task.num_cells, -1, cells)

    def layers(self, episode: Any, first_tick: int) -> Iterator[dict[str, bytes]]:
        """Of each step topic -> message, for viewers."""
        on = episode.action & ~episode.forced(self.task.t_max)[:, None]
        sensed = self.task.covered(on)
        return grid_messages(episode, self.task.size, first_tick, sensed)

    def decode(
        self, row: dict[str, Any], messages: Iterable[Said], *, whole: bool = False
    ) -> Episode:
        """The episode of a row, from messages among which are its own.

        Most figures of a step are for viewers, and follow from the others: with `whole` they are checked as well, which
        takes as long as the rest.

        Raises:
            UserError, ValueError, KeyError, TypeError: they do not fit together.
        """
        begin, end = int(row["start_time"]), int(row["end_time"])
        mine: dict[str, list[bytes]] = {topic: [] for topic in ("/step", *self.read_layers)}
        for topic, time, text in messages:
            if begin <= time <= end:
                mine.setdefault(topic, []).append(text)
        said = [json.loads(step) for step in mine["/step"]]
        # Lengths first: a row may claim any length.
        counts = {len(mine[topic]) for topic in ("/step", *self.read_layers)}
        places = [(each["episode"], each["t"]) for each in said]
        if counts != {row["length"]} or places != [(row["episode"], t) for t in range(len(said))]:
            raise UserError(f"episode={row['episode']}: its steps do not fit together")
        found = self._episode(row, said, mine)
        if whole and [json.loads(step) for step in self.steps(found)] != said:
            raise UserError(f"episode={row['episode']}: figures of its steps do not fit together")
        return found

    def _episode(
        self, row: dict[str, Any], said: list[dict[str, Any]], mine: dict[str, list[bytes]]
    ) -> Episode:
        """The episode of a row, the contents of its steps, and its messages by topic."""
        task, targets, modal = self.task, len(self.problem.targets), modes_of(self.problem) > 1
        names = ("n", "target", "obs", "mode") if modal else ("n", "target", "obs")
        parts = [np.array([each[name] for each in said], np.int64) for name in names]
        start, shape = np.array(row["start"], np.int64), (targets,) if targets else ()
        begun = np.array(row["start_mode"], np.int64) if modal else 0 * start
        if {start.shape, begun.shape} != {shape} or any(
            part.shape != (len(said), *shape) for part in parts
        ):
            raise ValueError(f"steps or starts of other than {targets or 1} targets")
        misses, target, seen, *mode = parts
        action = np.zeros((len(said), task.total_sensors), bool)
        for t, each in enumerate(said):
            action[t, each["active"]] = True
        start = np.where(start < 0, task.num_cells, start)
        reward = np.array([each["reward"] for each in said])
        if np.any(start > task.num_cells - (not targets)) or np.any(abs(reward) > _HUGE):
            raise ValueError("a start outside of the grid, or a reward out of range")
        return Episode(
            number=row["episode"],
            seed=int(row["seed"]),
            **{name: row[name] for name in ("policy", "terminated", "truncated")},
            start=start if targets else int(start),
            misses=misses,
            action=action,
            target=np.where(target < 0, task.num_cells, target),
            located=seen >= 0,
            reward=reward.astype(np.float32),
            mode=mode[0] if modal else None,
            first_tick=tick_of(int(row["start_time"])),
            start_mode=begun if targets else int(begun),
            **self._beliefs(mine),
        )

    def _beliefs(self, mine: dict[str, list[bytes]]) -> dict[str, Any]:
        """Beliefs and probabilities of an episode, from its messages by topic."""
        belief, probability = read_grids(mine["/grid"], self.task.size)
        return {"belief": belief, "probability": probability}


class GroupForm(Form):
    """The form of the episodes of several targets."""

    @property
    def read_layers(self) -> Sequence[str]:
        """See `Form`."""
        return [belief_topic(target) for target in range(len(self.problem.targets))]

    def layers(self, episode: Episode, first_tick: int) -> Iterator[dict[str, bytes]]:
        """See `Form`."""
        (rows, columns), targets = self.task.size, len(episode.start)
        sensed = self.task.covered(episode.action).reshape(-1, rows, columns)
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
            said = {topic: boxed(stamp, cells, box, 0) for topic, cells, box in drawn}
            said["/active"] = boxed(stamp, sensed[t].view(ACTIVE), active, 0.01)
            said["/targets"] = self._scene(episode, t, first_tick + t)
            yield said | {"/part": part_text(stamp, columns / 2, rows / 2)}

    def _scene(self, episode: Episode, t: int, tick: int) -> bytes:
        """The targets that are in the grid, in place of those of the step before."""
        rows, columns = self.task.size
        time, entities = clock_of(tick), []
        for k in np.flatnonzero(episode.target[t] < self.task.num_cells).tolist():
            row, column = divmod(int(episode.target[t, k]), columns)
            place = {"x": column + 0.5, "y": rows - row - 0.5}
            colour = shares_of(k) | {"a": 1 if episode.located[t, k] else _FAINT}
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
                rows.append(np.full(len(cell), t * len(topics) + k))
                columns.append(cell)
                masses.append(mass)
        entries = np.concatenate(masses), (np.concatenate(rows), np.concatenate(columns))
        shape = len(mine[topics[0]]) * len(topics), task.num_cells
        belief = sparse.csr_array(entries, shape=shape)
        belief.eliminate_zeros()
        return {"belief": belief}


def _at(place: Mapping[str, float], height: float, **more: Any) -> dict[str, Any]:
    """A part of an entity in a place of the grid, upright."""
    return {"pose": {"position": {**place, "z": height}, "orientation": _UPRIGHT}, **more}


def form_of(problem: Subject) -> Form:
    """The form of the episodes of a log, of one target or of several; see `Form`."""
    return (GroupForm if problem.targets else Form)(problem)
