"""Names at the ends of lines, where a legend would have to be matched by colour.

Lines that cannot be told apart, because they coincide, are named one under the other, "= " before each but the first.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from trackmdp.reports.style import TEXT, Axes, Canvas, legend
from trackmdp.world.model import Array

_TOUCHING = 0.012
"""Parts of the height of the axes: lines are some 2 points wide, of 200; closer ones are seen as one."""
_LINE_HEIGHT = 1.25 * TEXT
_LONGEST = 20
"""Letters in a row of a label: a longer name is broken, so that half of a phone's width is left for the lines."""


@dataclass
class _Named:
    """A line as it is drawn in one of the axes: its points in parts of that axes' height, the last one in data."""

    axes: Axes
    name: str
    colour: Any
    heights: Array
    end: tuple[float, float]
    same: bool = False

    @property
    def rows(self) -> list[str]:
        """The name as it is written."""
        return textwrap.wrap(("= " if self.same else "") + self.name, _LONGEST, break_on_hyphens=False)


def label_lines(figure: Canvas, parts: Sequence[Axes], first: Sequence[str] = ()) -> None:
    """Name the lines of the axes at their right ends; below the axes as a legend where they are too many for that.

    Args:
        figure: of the axes.
        parts: the axes, or the two parts of broken ones, whose limits are final.
        first: names of lines that are what a figure is about: of lines that coincide they come first.
    """
    placed: list[tuple[Axes, list[_Named], Array]] = []
    for axes in parts:
        groups = _groups(_named(axes), first)
        labels = [named for group in groups for named in group]
        room = axes.get_position().height * figure.get_figheight() * 72  # points; the layout changes it little
        tall = np.array([len(named.rows) * _LINE_HEIGHT / room for named in labels])
        wanted = [group[0].heights[-1] for group in groups for _ in group]
        if tall.sum() > 1.15:
            legend(figure, parts[0], first=first)
            return
        placed.append((axes, labels, spread(wanted, tall)))
    for axes, labels, heights in placed:
        for named, height in zip(labels, heights, strict=True):
            # From the end of the line to its name, which may stand higher or lower to make room for others.
            arrow = {"arrowstyle": "-", "color": named.colour, "linewidth": 0.6, "relpos": (0, 0.5)}
            arrow |= {"shrinkA": 1, "shrinkB": 1}
            where: Any = {"textcoords": "axes fraction", "va": "center", "annotation_clip": False}
            where |= {"color": named.colour, "arrowprops": None if named.same else arrow}
            axes.annotate("\n".join(named.rows), named.end, (1.05, height), **where)


def spread(wanted: Sequence[float], tall: Array) -> Array:
    """Heights `[K]` as near to the `wanted` ones, which fall, as labels that are so `tall` allow, in parts of the axes.

    With u_k = height_k + c_k, c_k the distance of label k from the first if they stood close, labels do not overlap
    where u falls: the nearest such u in squares is the isotonic regression of the wanted one.

    Example: both at .5, each .1 tall, c = (0, .1): the wanted u (.5, .6) rises, (.55, .55) is nearest, so .55 and .45.
    """
    from scipy.optimize import isotonic_regression  # half a second to load

    if not len(tall):
        return np.zeros(0)
    close = np.concatenate([[0.0], np.cumsum((tall[:-1] + tall[1:]) / 2)])
    fitted = isotonic_regression(np.asarray(wanted) + close, increasing=False).x
    # Inside of the axes' height as far as there is room; a shift of the ends keeps u falling.
    top, bottom = 1.0 - tall[0] / 2, tall[-1] / 2 + close[-1]
    return np.clip(fitted, min(bottom, top), top) - close


def _named(axes: Axes) -> Iterator[_Named]:
    """The lines of the axes that end in sight."""
    for handle, name in zip(*axes.get_legend_handles_labels(), strict=True):
        # an errorbar's first part is its line
        line: Any = handle[0] if isinstance(handle, tuple) else handle
        points = np.column_stack([np.asarray(data, dtype=float) for data in line.get_data()])
        known = points[np.isfinite(points).all(axis=1)]
        if not len(known):
            continue
        to_parts = axes.transData + axes.transAxes.inverted()
        heights = to_parts.transform(points)[:, 1]
        end = to_parts.transform(known[-1:])[0, 1]
        if -0.01 <= end <= 1.01:  # else in the other part of broken axes
            heights[-1] = end
            yield _Named(axes, name, line.get_color(), heights, (float(known[-1, 0]), float(known[-1, 1])))


def _groups(lines: Iterable[_Named], first: Sequence[str]) -> list[list[_Named]]:
    """The lines from the highest end to the lowest, those that coincide all the way together."""
    groups: list[list[_Named]] = []
    for named in sorted(lines, key=lambda line: line.name not in first):
        for group in groups:
            other = group[0].heights
            # Where one of them has no point, they are not seen to differ.
            if len(other) == len(named.heights) and not (np.abs(other - named.heights) > _TOUCHING).any():
                named.same = True
                group.append(named)
                break
        else:
            groups.append([named])
    return sorted(groups, key=lambda group: -group[0].heights[-1])
