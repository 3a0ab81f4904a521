"""An episode as a video: `.gif`, or with the extra `video` `.mp4`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from trackmdp.episodes.episode import Episode
from trackmdp.episodes.player import sentence
from trackmdp.errors import UserError, require
from trackmdp.notebook.drawing import BLUE, INK, ORANGE
from trackmdp.world.model import BoolArray
from trackmdp.world.tracks import Problem

MOST_STEPS = 2000
"""Frames of a video; a longer episode is cut there."""
_DPI = 110


def write_video(file: Path, problem: Problem, episode: Episode, speed: int) -> None:
    """Write one frame for each step: belief, cells sensed, the target and its last ten moves.

    Args:
        file: ends with `.gif` or `.mp4`.
        problem: where the episode took place.
        episode: with its belief.
        speed: steps per second.

    Raises:
        UserError: another ending, or a package is missing.
    """
    writer = _writer(file, speed)
    from matplotlib.figure import Figure

    rows, columns = problem.size
    figure = Figure(figsize=(min(6.4, 2 + 5.0 * columns / max(rows, columns)), 6.4), dpi=_DPI)
    axes = figure.subplots()
    part = file.with_name(f".{file.name}.part{file.suffix}")  # whole under its name, or not at all
    try:
        with writer.saving(figure, part, _DPI):
            for t in range(min(len(episode), MOST_STEPS)):
                _frame(axes, problem, episode, t)
                writer.grab_frame()
        part.replace(file)
    finally:
        part.unlink(missing_ok=True)


def _writer(file: Path, speed: int) -> Any:
    """Matplotlib's writer for the ending."""
    require("matplotlib", "video", "video")
    import matplotlib
    from matplotlib.animation import FFMpegWriter, PillowWriter

    if file.suffix == ".gif":
        return PillowWriter(speed)
    if file.suffix != ".mp4":
        raise UserError(f"video: {file.name}, expected a file that ends with .gif or .mp4")
    require("imageio_ffmpeg", "video", "video")
    import imageio_ffmpeg

    matplotlib.rcParams["animation.ffmpeg_path"] = imageio_ffmpeg.get_ffmpeg_exe()
    return FFMpegWriter(speed)


def _frame(axes: Any, problem: Problem, episode: Episode, t: int) -> None:
    """Draw a step."""
    axes.clear()
    rows, columns = problem.size
    belief = np.zeros(problem.num_cells) if episode.belief is None else episode.belief[t]
    shade = np.sqrt(belief).reshape(rows, columns)  # so that small probabilities show
    axes.imshow(shade, cmap="Blues", vmin=0, vmax=1.4)
    sensed: BoolArray = problem.covered(episode.action[t]) & (episode.misses[t] <= problem.t_max)
    marks = {
        "marker": "s",
        "facecolors": "none",
        "edgecolors": ORANGE,
        "s": 70_000 / max(rows, columns) ** 2,
    }
    down, across = np.divmod(np.flatnonzero(sensed), columns)
    axes.scatter(across, down, **marks)
    path = np.array([episode.start, *episode.target[: t + 1]])[-11:]
    path = path[path < problem.num_cells]
    down, across = np.divmod(path, columns)
    axes.plot(across, down, color=INK, linewidth=1, alpha=0.5)
    if episode.target[t] < problem.num_cells:
        face = INK if episode.located[t] else "none"
        axes.scatter(across[-1:], down[-1:], s=60, facecolors=face, edgecolors=INK, zorder=3)
    axes.set_xticks(np.arange(columns + 1) - 0.5, labels=[])
    axes.set_yticks(np.arange(rows + 1) - 0.5, labels=[])
    axes.tick_params(length=0)
    axes.grid(color="#dddddd", linewidth=0.5)
    outcome, _, rest = sentence(episode, t, problem).partition("; ")
    axes.set_title(f"{outcome}\n{rest}", loc="left", fontsize=8)
    key = "square: sensor on   disc: target located   ring: missed"
    axes.set_xlabel(
        key if episode.belief is None else f"blue: belief   {key}", fontsize=8, color=BLUE
    )
