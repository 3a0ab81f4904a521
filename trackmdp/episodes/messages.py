"""Steps and episodes as messages, written as text directly: most of the time of logging goes here."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, TypeAlias

import numpy as np

from trackmdp.episodes.episode import Episode, Recording
from trackmdp.episodes.grids import read_grids
from trackmdp.episodes.schema import LoggedRun, tick_of, time_of
from trackmdp.errors import UserError

Messages: TypeAlias = Mapping[str, list[bytes]]
"""Topic -> the messages of an episode, in the order of its steps."""

_WORDS = ("false", "true")


def row_of(episode: Recording, start: Any, t_max: int, first_tick: int) -> dict[str, Any]:
    """The `/episode` message; `start` is a cell, or one for each of several targets."""
    return {
        "episode": episode.number,
        # Seeds have 63 bits and times in ns 60: as JSON numbers, a viewer in JavaScript would round them, which it
        # does beyond 2^53.
        "seed": str(episode.seed),
        "policy": episode.policy,
        "start": start,
        "length": len(episode),
        "return": float(episode.returns[-1]),
        "detections": int(episode.located.sum()),
        "forced": int(episode.forced(t_max).sum()),
        "terminated": episode.terminated,
        "truncated": episode.truncated,
        "start_time": str(time_of(first_tick)),
        "end_time": str(time_of(first_tick + len(episode) - 1)),
    }


def step_messages(episode: Episode, run: LoggedRun) -> Iterator[bytes]:
    """The `/step` messages."""
    (rows, columns), last = run.size, len(episode) - 1
    # -1 for no cell: a schema with null is refused by viewers, topic and all.
    target = np.where(episode.target == run.cells, -1, episode.target)
    x = np.where(target < 0, -1, target % columns)
    # Cells are numbered from the top left, a plot's y axis points upwards: in 3 rows of 4, cell 5 is at x = 1, y = 1,
    # cell 0 at x = 0, y = 2.
    y = np.where(target < 0, -1, rows - 1 - target // columns)
    steps, ids = np.nonzero(episode.action)
    # np.nonzero lists (step, sensor) in order of steps: steps 0 0 1 3 with sensors 2 5 4 0. searchsorted finds where
    # steps 1, 2, 3 begin, 2 3 3, and split makes of those [2 5] [4] [] [0].
    active = [
        ",".join(map(str, each.tolist()))
        for each in np.split(ids, np.searchsorted(steps, range(1, last + 1)))
    ]
    known = (episode.misses, episode.last_cell, episode.action.sum(1), episode.forced(run.t_max))
    came = (target, x, y, episode.observation, episode.reward.astype(np.float64), episode.returns)
    # Of targets with a mode, one more entry at the end.
    modes = (
        [""] * len(episode)
        if episode.mode is None
        else [f',"mode":{mode}' for mode in episode.mode.tolist()]
    )
    # tolist() once for each column: Python's numbers are formatted several times faster than NumPy's scalars.
    for t, (n, cell, count, forced, at, at_x, at_y, obs, reward, total) in enumerate(
        zip(*(column.tolist() for column in (*known, *came)), strict=True)
    ):
        yield (
            f'{{"episode":{episode.number},"t":{t},"n":{n},"last_cell":{cell},"active":[{active[t]}],'
            f'"n_active":{count},"forced":{_WORDS[forced]},"target":{at},"target_x":{at_x},"target_y":{at_y},'
            f'"obs":{obs},"reward":{reward!r},"ep_return":{total!r},'
            f'"first":{_WORDS[t == 0]},"last":{_WORDS[t == last]}{modes[t]}}}'
        ).encode()


def decode(row: dict[str, Any], messages: Messages, run: LoggedRun) -> Episode:
    """The episode of one target that these messages of the log `run` were made from.

    Raises:
        UserError, ValueError, KeyError, TypeError: they do not fit together.
    """
    said = steps_said(row, messages, ("/grid",))
    belief, probability = read_grids(messages["/grid"], run.size)
    return Episode(
        **common(row, said, run),
        start=row["start"],
        belief=belief,
        probability=probability,
        mode=np.array([each["mode"] for each in said], dtype=np.int64) if run.modes else None,
        start_mode=row["start_mode"] if run.modes else 0,
    )


def steps_said(
    row: dict[str, Any], messages: Messages, layers: Iterable[str]
) -> list[dict[str, Any]]:
    """The contents of the `/step` messages of an episode.

    Raises:
        UserError: they, or the messages of `layers`, are not as many as its row says.
    """
    number, count = row["episode"], row["length"]
    said = [json.loads(step) for step in messages["/step"]]
    # Lengths first: a row may claim any length.
    steps_of = ((each["episode"], each["t"]) for each in said)
    if any(len(messages.get(topic, ())) != count for topic in ("/step", *layers)) or any(
        each != (number, t) for t, each in enumerate(steps_of)
    ):
        raise UserError(f"episode={number}: its steps do not fit together")
    return said


def common(row: dict[str, Any], said: list[dict[str, Any]], run: LoggedRun) -> dict[str, Any]:
    """What an episode of one target and one of several are both made of."""
    target = np.array([each["target"] for each in said], dtype=np.int64)
    action = np.zeros((len(said), run.sensors), dtype=bool)
    for t, each in enumerate(said):
        action[t, each["active"]] = True
    return {
        "number": row["episode"],
        "seed": int(row["seed"]),
        **{name: row[name] for name in ("policy", "terminated", "truncated")},
        "misses": np.array([each["n"] for each in said], dtype=np.int64),
        "action": action,
        "target": np.where(target < 0, run.cells, target),
        "located": np.array([each["obs"] for each in said]) >= 0,
        "reward": np.array([each["reward"] for each in said], dtype=np.float32),
        "first_tick": tick_of(int(row["start_time"])),
    }
