"""An episode as a video: `.gif`, or with the extra `video` `.mp4`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from trackmdp.arrays.types import BoolArray
from trackmdp.durable import no_trace
from trackmdp.episodes.episode import Episode
from trackmdp.episodes.episode_page import MOST_STEPS
from trackmdp.episodes.sentences import sentence
from trackmdp.episodes.target_colours import colour_of
from trackmdp.errors import UserError, require
from trackmdp.notebook.drawing import BLUE, INK, ORANGE
from trackmdp.sensing.task import Task

_DPI = 110


def write_video(file: Path, task: Task, episode: Episode, speed: int) -> None:
    """Write one frame for each step: belief, cells sensed, the target and its last ten moves.

    Args:
        file: ends with `.gif` or `.mp4`.
        task: where the episode took place; a world, for the modes of its target in words.
        episode: with its belief.
        speed: steps per second.

    Raises:
        UserError: another ending, or a package is missing.
    """
    if file.suffix not in (".gif", ".mp4"):
        raise UserError(f"video: {file.name}, expected a file that ends with .gif or .mp4")
    require("matplotlib", "video", "video")
    if file.suffix == ".mp4":
        require("imageio_ffmpeg", "video", "video")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows, columns = task.size
    figure = Figure(figsize=(min(6.4, 2 + 5.0 * columns / max(rows, columns)), 6.4), dpi=_DPI)
    canvas, axes = FigureCanvasAgg(figure), figure.subplots()

    def drawn() -> Iterator[None]:
        for t in range(min(len(episode), MOST_STEPS)):
            _frame(axes, task, episode, t)
            yield

    part = file.with_name(f".{file.name}.part{file.suffix}")  # whole under its name, or not at all
    with no_trace(part, file):
        (_write_gif if file.suffix == ".gif" else _write_mp4)(part, drawn(), canvas, speed)
        part.replace(file)


def _write_gif(part: Path, drawn: Iterator[None], canvas: Any, speed: int) -> None:
    """Write each frame as soon as it is drawn: only the part that differs from the one before, with its own colours.

    PIL's `save` and matplotlib's writer keep all frames until the last one is there.
    """
    from PIL import Image, ImageChops
    from PIL.GifImagePlugin import getdata, getheader

    before = None
    with part.open("wb") as stream:
        for _ in drawn:
            canvas.draw()
            now = Image.fromarray(np.array(canvas.buffer_rgba())[..., :3])
            box: Any = (0, 0, *now.size)
            if before is not None:
                # Of one like the one before a pixel, so that it takes its time.
                box = ImageChops.difference(before, now).getbbox() or (0, 0, 1, 1)
            image = now.crop(box).quantize(64)
            if before is None:
                stream.writelines(getheader(image, info={"loop": 0})[0])
            before = now
            look = {"duration": 1000 // speed, "include_color_table": True}
            stream.writelines(getdata(image, box[:2], **look))
        stream.write(b";")


def _write_mp4(part: Path, drawn: Iterator[None], canvas: Any, speed: int) -> None:
    import imageio_ffmpeg
    import matplotlib
    from matplotlib.animation import FFMpegWriter

    matplotlib.rcParams["animation.ffmpeg_path"] = imageio_ffmpeg.get_ffmpeg_exe()
    writer = FFMpegWriter(speed)
    with writer.saving(canvas.figure, part, _DPI):
        for _ in drawn:
            writer.grab_frame()


def _frame(axes: Any, task: Task, episode: Episode, t: int) -> None:
    """Draw a step."""
    axes.clear()
    rows, columns = task.size
    # The root, so that small probabilities show.
    shade = np.sqrt(np.minimum(episode.expected(t), 1.0)).reshape(rows, columns)
    # A mesh has the lines of the grid in it: ticks at all of them take a third of the time.
    mesh = {"edgecolors": "#dddddd", "linewidth": 0.5, "vmin": 0, "vmax": 1.4}
    axes.pcolormesh(range(columns), range(rows), shade, cmap="Blues", shading="nearest", **mesh)
    axes.set(
        xticks=[], yticks=[], aspect="equal", xlim=(-0.5, columns - 0.5), ylim=(rows - 0.5, -0.5)
    )
    sensed: BoolArray = task.covered(episode.action[t]) & ~episode.forced(task.t_max)[t]
    down, across = np.divmod(np.flatnonzero(sensed), columns)
    area = 70_000 / max(rows, columns) ** 2
    axes.scatter(across, down, marker="s", facecolors="none", edgecolors=ORANGE, s=area)
    several = episode.several
    paths = np.concatenate([[episode.start], episode.target[: t + 1]]).reshape(t + 2, -1)[-11:].T
    for target, path in enumerate(paths):
        colour = colour_of(target) if several else INK
        _target(axes, path, task, np.atleast_1d(episode.located[t])[target], colour)
        if several and path[-1] < task.num_cells:
            row, column = divmod(int(path[-1]), columns)
            axes.annotate(
                f"{target}", (column + 0.2, row - 0.2), color=colour, fontsize=8, zorder=4
            )
    outcome, _, rest = sentence(episode, t, task).partition("; ")
    axes.set_title(f"{outcome}\n{rest}", loc="left", fontsize=8, wrap=True)
    key = "blue: belief   square: sensor on   disc: target located   ring: missed"
    axes.set_xlabel(key, fontsize=8, color=BLUE)


def _target(axes: Any, path: Any, task: Task, located: bool, colour: str) -> None:
    """Draw a target and its last moves; once it has left, only the moves."""
    there = path[path < task.num_cells]
    down, across = np.divmod(there, task.columns)
    axes.plot(across, down, color=colour, linewidth=1, alpha=0.5)
    if path[-1] < task.num_cells:
        face = colour if located else "none"
        axes.scatter(across[-1:], down[-1:], s=60, facecolors=face, edgecolors=colour, zorder=3)
