"""Steps of several targets as messages: numbers of all in one, and for viewers beliefs and places of each.

`/grid` has how many targets are expected in each cell, `/belief/K` where target K is, in the smallest rectangle around
it, and `/targets` a disc for each target in a colour of its own, with its number; it is faint where the target was
missed.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy import sparse

from trackmdp.episodes.grids import (
    ACTIVE,
    WHOLE_CELLS,
    boxes_of,
    constant,
    grid_text,
    part_text,
    read_grid,
    stamp_of,
)
from trackmdp.episodes.group_episode import GroupEpisode
from trackmdp.episodes.messages import Messages, common, steps_said
from trackmdp.episodes.schema import LoggedRun, belief_topic, time_of
from trackmdp.episodes.target_colours import shares_of

_BELIEF = np.dtype([("belief", "<f4")])
_SAYS, _ACTIVE_SAYS = constant(_BELIEF), constant(ACTIVE)
_ABOVE, _UPRIGHT = 0.02, {"x": 0, "y": 0, "z": 0, "w": 1}
_FAINT = 0.4
"""Opacity of a target that was missed."""


def group_steps(episode: GroupEpisode, run: LoggedRun) -> Iterator[bytes]:
    """The `/step` messages."""
    (rows, columns), last = run.size, len(episode) - 1
    target = np.where(episode.target == run.cells, -1, episode.target)
    # As with one target -1 stands for no cell, and y points upwards.
    x, row = np.where(target < 0, -1, target % columns), target // columns
    y = np.where(target < 0, -1, rows - 1 - row)
    forced = episode.forced(run.t_max)
    for t in range(len(episode)):
        active = np.flatnonzero(episode.action[t]).tolist()
        said = {"episode": episode.number, "t": t, "n": episode.misses[t].tolist()}
        said |= {"last_cell": episode.last_cell[t].tolist(), "active": active}
        said |= {"n_active": len(active), "forced": bool(forced[t]), "target": target[t].tolist()}
        said |= {"target_x": x[t].tolist(), "target_y": y[t].tolist()}
        said |= {"obs": episode.observation[t].tolist(), "n_present": int((target[t] >= 0).sum())}
        said |= {"reward": float(episode.reward[t]), "ep_return": float(episode.returns[t])}
        said |= {"first": t == 0, "last": t == last}
        yield _text(said)


def group_layers(
    episode: GroupEpisode, run: LoggedRun, first_tick: int
) -> Iterator[dict[str, bytes]]:
    """Of each step topic -> message, for viewers."""
    assert episode.belief is not None
    (rows, columns), targets = run.size, len(episode.start)
    for t in range(len(episode)):
        stamp = stamp_of(first_tick + t)
        each = episode.belief[t * targets : (t + 1) * targets].toarray()
        # From the numbers that are logged, so that a log written anew has the same bytes.
        every = each.sum(axis=0, dtype=np.float64).astype(np.float32)
        beliefs = np.concatenate([every[None], each]).reshape(-1, rows, columns)
        used = beliefs > 0
        used[0] |= rows * columns <= WHOLE_CELLS
        topics = ["/grid", *map(belief_topic, range(targets))]
        said = {
            topic: grid_text(
                stamp, _SAYS, belief[top:bottom, left:right].view(_BELIEF), left, rows - bottom, 0
            )
            for topic, belief, (top, bottom, left, right) in zip(
                topics, beliefs, boxes_of(used), strict=True
            )
        }
        active = episode.action[t].reshape(1, rows, columns)
        ((top, bottom, left, right),) = boxes_of(active)
        sensed = active[0, top:bottom, left:right].view(np.uint8)
        said["/active"] = grid_text(stamp, _ACTIVE_SAYS, sensed, left, rows - bottom, 0.01)
        said["/targets"] = _scene(episode, t, run, first_tick + t)
        yield said | {"/part": part_text(stamp, columns / 2, rows / 2)}


def _scene(episode: GroupEpisode, t: int, run: LoggedRun, tick: int) -> bytes:
    """The targets that are in the grid, in place of those of the step before."""
    rows, columns = run.size
    seconds, rest = divmod(time_of(tick), 1_000_000_000)
    time = {"sec": seconds, "nsec": rest}
    entities = []
    for k in np.flatnonzero(episode.target[t] < run.cells).tolist():
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
    return _text({"deletions": [everything], "entities": entities})


def _text(said: dict[str, Any]) -> bytes:
    return json.dumps(said, allow_nan=False, separators=(",", ":")).encode()


def decode_group(row: dict[str, Any], messages: Messages, run: LoggedRun) -> GroupEpisode:
    """The episode of several targets that these messages of the log `run` were made from.

    Raises:
        UserError, ValueError, KeyError, TypeError: they do not fit together.
    """
    targets = len(run.kinds)
    topics = [belief_topic(each) for each in range(targets)]
    said = steps_said(row, messages, topics)
    found = common(row, said, run)
    shape = len(said), targets
    if any(found[name].shape != shape for name in ("misses", "target", "located")):
        raise ValueError(f"steps of other than {targets} targets")
    start = np.array(row["start"], dtype=np.int64)
    if start.shape != (targets,):
        raise ValueError(f"starts of other than {targets} targets")
    return GroupEpisode(**found, start=start, belief=_belief(topics, messages, run))


def _belief(topics: list[str], messages: Messages, run: LoggedRun) -> sparse.csr_array:
    """`[T · K, M]` of the messages of each target."""
    places = np.arange(run.cells).reshape(run.size)
    rows, columns, masses = [], [], []
    for k, topic in enumerate(topics):
        for t, text in enumerate(messages[topic]):
            part, cells = read_grid(text, run.size, _BELIEF)
            mass, cell = cells["belief"].ravel(), places[part].ravel()
            some = np.flatnonzero(mass)
            rows.append(np.full(len(some), t * len(topics) + k))
            columns.append(cell[some])
            masses.append(mass[some])
    entries = np.concatenate(masses), (np.concatenate(rows), np.concatenate(columns))
    return sparse.csr_array(entries, shape=(len(messages["/step"]) * len(topics), run.cells))
