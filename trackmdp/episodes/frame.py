"""A step of an episode in plain text."""

from __future__ import annotations

import math

import numpy as np

from trackmdp.episodes.episode import Episode
from trackmdp.world.model import Task
from trackmdp.world.modes import HiddenWorld
from trackmdp.world.render import FOUND, MISSED, ON, around, symbols

WIDE, STEP = 37, 9
"""Rows and columns of a grid that are drawn at most, which 80 characters hold, and how far the part drawn moves at
once: it stays where it is while the target does not leave 9 x 9 cells."""
_SHADES = " ·░▒▓"
_ARROWS = "→↗↑↖←↙↓↘"
_STILL = 0.05
"""Mean cells a step below which a mode has no direction."""
LEGEND = f"{FOUND} target, located   {MISSED} target, missed   {ON} sensor on   ·░▒▓ where it was expected"


def outcome(episode: Episode, t: int, task: Task) -> str:
    """What became of step `t`: exited, forced, detected or missed."""
    if episode.target[t] == task.num_cells:
        return "exited"
    if episode.misses[t] > task.t_max:
        return "forced"
    return "detected" if episode.located[t] else "missed"


def where(cell: int, columns: int) -> str:
    """A cell in words, counted from 1."""
    return f"row {cell // columns + 1}, column {cell % columns + 1}"


def mode_words(world: HiddenWorld, mode: int) -> str:
    """A mode in words: its number, as in the log, and how it moves on average."""
    down, across = world.drift[mode]
    speed = math.hypot(down, across)
    # Up is to smaller rows; eighths of a turn from the right, turning left.
    eighth = round(math.atan2(-down, across) / (math.pi / 4)) % 8
    return f"mode {mode}" + (f" {_ARROWS[eighth]} {speed:.1f} cells a step" if speed > _STILL else "")


def sentence(episode: Episode, t: int, task: Task) -> str:
    """A step in one line; with the target's mode, where `task` is a world of targets that have one."""
    state = outcome(episode, t, task)
    words = {
        "exited": "the target has left the grid",
        "forced": f"safe action forced, target located in {where(int(episode.target[t]), task.columns)}",
        "detected": f"target detected in {where(int(episode.target[t]), task.columns)}",
        "missed": f"target missed in {where(int(episode.target[t]), task.columns)}",
    }
    on = "" if state == "forced" else f"{int(episode.action[t].sum())} sensors on, "
    mode = ""
    if isinstance(task, HiddenWorld) and episode.mode is not None and episode.mode[t] >= 0:
        mode = f" in {mode_words(task, int(episode.mode[t]))}"
    return (
        f"step {t + 1} of {len(episode)}: {words[state]}{mode}; {on}{int(episode.misses[t])} misses before; "
        f"reward {episode.reward[t]:.2f}, total {episode.returns[t]:.2f}"
    )


def frame(episode: Episode, t: int, task: Task) -> str:
    """The grid at a step, of a large one the part around the target: it, over the sensors on, over the belief."""
    belief = np.zeros(task.num_cells) if episode.belief is None else episode.belief[t]
    # digitize gives 0 below 1e-6, 1 below .05, ... 4 from .5 on: an index into the shades.
    levels = np.digitize(belief, [1e-6, 0.05, 0.2, 0.5])
    on = task.covered(episode.action[t]) & (outcome(episode, t, task) != "forced")
    shades, found = np.array(list(_SHADES))[levels], bool(episode.located[t])
    marks = symbols(task.size, int(episode.target[t]), on, found=found, empty=shades)
    down, across = _part(episode, t, task)
    rows = [" ".join(row[across.start : across.stop]) for row in marks[down.start : down.stop]]
    edge = "─" * (2 * len(across) + 1)
    lines = [f"┌{edge}┐", *(f"│ {row} │" for row in rows), f"└{edge}┘"]
    if (len(down), len(across)) != task.size:
        cut = zip(("rows", "columns"), (down, across), task.size, strict=True)
        # counted from 1, as in `where`
        lines.append(", ".join(f"{name} {part[0] + 1} to {part[-1] + 1} of {length}" for name, part, length in cut))
    return "\n".join(lines)


def _part(episode: Episode, t: int, task: Task) -> tuple[range, range]:
    """The rows and columns that are drawn: those around the target, or around where it was before it left."""
    at = int(episode.target[t])
    if at == task.num_cells:
        at = int(episode.target[t - 1]) if t else int(episode.start)
    # Row 100 lies in the part of rows 99 to 107, whose middle is 103.
    row, column = (place // STEP * STEP + STEP // 2 for place in divmod(at, task.columns))
    return around(row, task.rows, WIDE), around(column, task.columns, WIDE)
