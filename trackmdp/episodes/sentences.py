"""Steps of an episode in words."""

from __future__ import annotations

import math

import numpy as np

from trackmdp.arrays.types import BoolArray
from trackmdp.episodes.episode import Episode
from trackmdp.sensing.task import Task
from trackmdp.world.model import World

_ARROWS = "→↗↑↖←↙↓↘"
_STILL = 0.05
"""Mean cells a step below which a mode has no direction."""
_NAMED = 4
"""Targets whose outcomes are listed one by one; of more the sentence counts the located ones."""


def where(cell: int, columns: int) -> str:
    """A cell in words, counted from 1."""
    return f"row {cell // columns + 1}, column {cell % columns + 1}"


def mode_words(world: World, mode: int) -> str:
    """A mode in words: its number, as in the log, and how it moves on average."""
    down, across = world.drift[mode]
    speed = math.hypot(down, across)
    # Up is to smaller rows; eighths of a turn from the right, turning left.
    eighth = round(math.atan2(-down, across) / (math.pi / 4)) % 8
    return f"mode {mode}" + (
        f" {_ARROWS[eighth]} {speed:.1f} cells a step" if speed > _STILL else ""
    )


def sentence(episode: Episode, t: int, task: Task) -> str:
    """A step in one line; with the target's mode, where `task` is a world of targets that have one."""
    forced = bool(episode.forced(task.t_max)[t])
    found = _of_several(episode, t, task, forced) if episode.several else _found(episode, t, task)
    misses = " ".join(map(str, np.atleast_1d(episode.misses[t])[:_NAMED]))
    if np.size(episode.misses[t]) > _NAMED:
        misses = f"up to {episode.misses[t].max()}"
    on = "" if forced else f"{episode.action[t].sum()} sensors on, "
    reward = f"reward {episode.reward[t]:.2f}, total {episode.returns[t]:.2f}"
    return f"step {t + 1} of {len(episode)}: {found}; {on}{misses} misses before; {reward}"


def _found(episode: Episode, t: int, task: Task) -> str:
    """What became of the one target."""
    if episode.target[t] == task.num_cells:
        return "the target has left the grid"
    mode, place = episode.mode, where(int(episode.target[t]), task.columns)
    seen = bool(episode.located[t])
    found = f"target {'detected' if seen else 'missed'} in {place}"
    if episode.misses[t] > task.t_max:
        found = f"safe action forced, target {'located' if seen else 'missed'} in {place}"
    if isinstance(task, World) and mode is not None:
        found += f" in {mode_words(task, int(mode[t]))}"
    return found


def _of_several(episode: Episode, t: int, task: Task, forced: bool) -> str:
    """What became of each target, or of many of them together."""
    target, located = episode.target[t], episode.located[t]
    lead, inside = "safe action forced, " if forced else "", target < task.num_cells
    if len(target) > _NAMED:
        missed, left = int((inside & ~located).sum()), int((~inside).sum())
        return (
            f"{lead}{located.sum()} of {len(target)} targets located, {missed} missed, {left} not in "
            "the grid"
        )
    before = np.append(np.atleast_2d(episode.start), episode.target[:t], axis=0)
    came: BoolArray = np.any(before < task.num_cells, axis=0)
    each = []
    for number, (cell, there, seen) in enumerate(zip(target, inside, located, strict=True)):
        state = f"{'located' if seen else 'missed'} in {where(int(cell), task.columns)}"
        away = "has left" if came[number] else "is not there yet"
        each.append(f"target {number} {state if there else away}")
    return lead + ", ".join(each)
