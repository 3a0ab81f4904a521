"""Episodes as messages, and read back from them: the form of the episodes of a log."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from trackmdp.episodes.container import Said
from trackmdp.episodes.episode import Episode
from trackmdp.episodes.grids import grid_messages, read_grids
from trackmdp.episodes.schema import json_bytes, modes_of, tick_of, time_of
from trackmdp.errors import UserError
from trackmdp.world.group import Group
from trackmdp.world.problem import Problem


class Form:
    """The form of the episodes of one target; see `trackmdp.episodes.group_messages` for several.

    Args:
        problem: where the episodes took place.
    """

    def __init__(self, problem: Problem | Group) -> None:
        self.problem, self.task = problem, problem.single

    @property
    def read_layers(self) -> Sequence[str]:
        """Topics of the layers that an episode is read from."""
        return ("/grid",)

    def row(self, episode: Any, first_tick: int) -> dict[str, Any]:
        """The `/episode` message."""
        of_mode = {} if episode.mode is None else {"start_mode": episode.start_mode}
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
        said: dict[str, Any] = {
            "episode": np.full(len(episode), episode.number),
            "t": t,
            "n": episode.misses,
            "last_cell": self._written(episode.last_cell),
            "active": active,
            "n_active": episode.action.sum(axis=1),
            "forced": episode.forced(self.task.t_max),
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
        coverage = self.task.coverage
        covered = None if coverage is None else coverage.cells(episode.action)
        return grid_messages(episode, self.task.size, first_tick, covered)

    def decode(self, row: dict[str, Any], messages: Iterable[Said]) -> Episode:
        """The episode of a row, from messages among which are its own.

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
        return self._episode(row, said, mine)

    def _episode(
        self, row: dict[str, Any], said: list[dict[str, Any]], mine: dict[str, list[bytes]]
    ) -> Episode:
        """The episode of a row, the contents of its steps, and its messages by topic."""
        task, targets, has_mode = self.task, len(self.problem.targets), modes_of(self.problem) > 1
        misses, target, seen = (
            np.array([each[name] for each in said], dtype=np.int64)
            for name in ("n", "target", "obs")
        )
        start, shape = np.array(row["start"], dtype=np.int64), (targets,) if targets else ()
        if start.shape != shape or any(
            each.shape != (len(said), *shape) for each in (misses, target, seen)
        ):
            raise ValueError(f"steps or starts of other than {targets or 1} targets")
        action = np.zeros((len(said), task.total_sensors), dtype=bool)
        for t, each in enumerate(said):
            action[t, each["active"]] = True
        start = np.where(start < 0, task.num_cells, start)
        modes = np.array([each["mode"] for each in said], dtype=np.int64) if has_mode else None
        return Episode(
            number=row["episode"],
            seed=int(row["seed"]),
            **{name: row[name] for name in ("policy", "terminated", "truncated")},
            start=start if targets else int(start),
            misses=misses,
            action=action,
            target=np.where(target < 0, task.num_cells, target),
            located=seen >= 0,
            reward=np.array([each["reward"] for each in said], dtype=np.float32),
            mode=modes,
            first_tick=tick_of(int(row["start_time"])),
            start_mode=row["start_mode"] if has_mode else 0,
            **self._beliefs(mine),
        )

    def _beliefs(self, mine: dict[str, list[bytes]]) -> dict[str, Any]:
        """Beliefs and probabilities of an episode, from its messages by topic."""
        belief, probability = read_grids(mine["/grid"], self.task.size)
        return {"belief": belief, "probability": probability}
