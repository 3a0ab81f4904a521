"""Keys: the memory of a policy at a detection, from which its plan of sets is read until the next detection.

A key is the located cell and a class of the detections before it, numbered cell · C + class, with C classes. Class 0
belongs to an episode's start, and with `cell`, the memory of the paper, is the only one. If a detection reveals the
mode (`kernel.reveals`) it is part of the key: each class is then one for each of H modes, class · H + mode.

A displacement is kept up to `clip` rows and columns, larger ones count as that; its number is that of a window of
2 · clip + 1 rows and columns. With clip 1, one row down and two columns to the right is clipped to (1, 1), and has the
number (1 + 1) · 3 + (1 + 1) = 8.

A memory of your own is a subclass of `Memory`, with a name in `trackmdp.config.MEMORIES`.
"""

from __future__ import annotations

import pkgutil
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

from trackmdp.config.world import MEMORIES
from trackmdp.grid.displacements import displacement


class Memory:
    """Classes of the detections before the last one. Methods take NumPy arrays or tensors of int64, of any one shape.

    Attributes:
        order: detections before the last one on which a class depends.
        t_max: T_max; a detection comes after 0 ... t_max + 1 misses.
        clip: rows and columns up to which displacements differ.
        displacements: numbers of displacements.
    """

    order: ClassVar[int] = 1

    def __init__(self, t_max: int, clip: int) -> None:
        self.t_max, self.clip, self.displacements = t_max, clip, (2 * clip + 1) ** 2

    @property
    def count(self) -> int:
        """Classes; class 0 is that of an episode's start."""
        raise NotImplementedError

    def after(self, known: Any, rows: Any, columns: Any, misses: Any) -> Any:
        """The class after a detection, `rows` and `columns` from the one before, which left the class `known`."""
        raise NotImplementedError

    def contexts(self, known: Any) -> list[tuple[Any, int]]:  # noqa: ARG002
        """Parts that classes `known` share with others, from coarse to fine: numbers below a count, and the count."""
        return []

    def formula(self, last: str, known: str) -> str:
        """`after` as Python, for the files that other programs read.

        Args:
            last: the number of the displacement.
            known: the class before; `misses` is known as well.
        """
        raise NotImplementedError


class Cell(Memory):
    """Nothing: the cell alone."""

    order = 0
    count = 1

    def after(self, known: Any, rows: Any, columns: Any, misses: Any) -> Any:  # noqa: ARG002
        """Always 0."""
        return known * 0

    def formula(self, last: str, known: str) -> str:  # noqa: ARG002
        """Always 0."""
        return "0"


class Displacement(Memory):
    """The displacement since the detection before."""

    @property
    def count(self) -> int:
        """One more than displacements."""
        return 1 + self.displacements

    def after(self, known: Any, rows: Any, columns: Any, misses: Any) -> Any:  # noqa: ARG002
        """Its number + 1, for 0 is the start."""
        return _number(rows, columns, self.clip) + 1

    def formula(self, last: str, known: str) -> str:  # noqa: ARG002
        """Its number + 1."""
        return f"1 + {last}"


class DisplacementGap(Displacement):
    """The displacement since the detection before, and the misses between the two: 1 + misses · D + number."""

    @property
    def count(self) -> int:
        """As many displacements for each number of misses."""
        return 1 + (self.t_max + 2) * self.displacements

    def after(self, known: Any, rows: Any, columns: Any, misses: Any) -> Any:
        """See the class."""
        return super().after(known, rows, columns, misses) + misses * self.displacements

    def contexts(self, known: Any) -> list[tuple[Any, int]]:
        """The displacement."""
        return [(((known - 1) % self.displacements + 1) * (known > 0), 1 + self.displacements)]

    def formula(self, last: str, known: str) -> str:  # noqa: ARG002
        """See the class."""
        return f"1 + {last} + misses * {self.displacements}"


class TwoDisplacements(Displacement):
    """The last two displacements, of the earlier one the direction alone (clip 1): last · 10 + direction.

    The direction is 0 after the first detection, which has no earlier displacement.
    """

    order = 2

    @property
    def count(self) -> int:
        """Nine directions and none, for each displacement."""
        return super().count * 10

    def after(self, known: Any, rows: Any, columns: Any, misses: Any) -> Any:
        """See the class."""
        last, side = known // 10, 2 * self.clip + 1
        down, across = (last - 1) // side - self.clip, (last - 1) % side - self.clip
        direction = (_number(down, across, 1) + 1) * (last > 0)
        return super().after(known, rows, columns, misses) * 10 + direction

    def contexts(self, known: Any) -> list[tuple[Any, int]]:
        """The last displacement."""
        return [(known // 10, 1 + self.displacements)]

    def formula(self, last: str, known: str) -> str:
        """See the class. Where `before` is 0 the remainder of a negative number counts for nothing."""
        before, side = f"({known} // 10)", 2 * self.clip + 1
        down = _clipped(f"({before} - 1) // {side} - {self.clip}", 1)
        across = _clipped(f"({before} - 1) % {side} - {self.clip}", 1)
        return f"(1 + {last}) * 10 + (5 + {down} * 3 + {across}) * ({before} > 0)"


@dataclass(frozen=True)
class KeySpace:
    """The keys of a task. All methods take NumPy arrays or tensors of int64, of any one shape.

    Attributes:
        size: (rows, columns) of the grid.
        t_max: T_max.
        memory: one of `trackmdp.config.MEMORIES`.
        clip: rows and columns up to which displacements differ.
        modes: H, modes that a detection reveals; 1 where it shows the cell alone.
    """

    size: tuple[int, int]
    t_max: int
    memory: str
    clip: int
    modes: int = 1

    @cached_property
    def _memory(self) -> Memory:
        kind: type[Memory] = pkgutil.resolve_name(MEMORIES[self.memory])
        return kind(self.t_max, self.clip)

    @property
    def order(self) -> int:
        """Detections before the last one on which a key depends."""
        return self._memory.order

    @property
    def num_classes(self) -> int:
        """C, classes of the detections before the last one."""
        return self._memory.count * self.modes

    @property
    def num_keys(self) -> int:
        """M · C."""
        return self.size[0] * self.size[1] * self.num_classes

    def start(self, cells: Any, modes: Any = 0) -> Any:
        """Keys of an episode that starts located in `cells`, in `modes` where a detection reveals them."""
        return self._keys(cells, 0, modes)

    def _keys(self, cells: Any, classes: Any, modes: Any) -> Any:
        if self.modes == 1:
            return cells * self.num_classes + classes
        return cells * self.num_classes + classes * self.modes + modes

    def cell(self, keys: Any) -> Any:
        """The located cells of `keys`."""
        return keys // self.num_classes

    def next(self, keys: Any, misses: Any, cells: Any, modes: Any = 0) -> Any:
        """Keys after a detection in `cells`, the one before having left `keys`, with `misses` in between."""
        if self.order == 0:
            return self.start(cells, modes)
        rows, across = displacement(self.size[1], self.cell(keys), cells)
        known = keys % self.num_classes // self.modes
        return self._keys(cells, self._memory.after(known, rows, across, misses), modes)

    def recipe(self) -> dict[str, str]:
        """The formulas of `start` and `next` for readers without this package, as lines of Python on whole numbers.

        `cell` and `mode` are those of the detection, `misses` the steps without one since the detection before it,
        which left the `key` that is replaced. `//` and `%` are those of whole numbers >= 0.
        """
        count, columns, clip = self.num_classes, self.size[1], self.clip
        own = "" if self.modes == 1 else " + mode"
        start = f"key = cell * {count}{own}" if count > 1 else "key = cell"
        if self.order == 0:
            return {"key_start": start, "key_next": start}
        down = _clipped(f"cell // {columns} - key // {count} // {columns}", clip)
        across = _clipped(f"cell % {columns} - key // {count} % {columns}", clip)
        last = f"(down + {clip}) * {2 * clip + 1} + across + {clip}"
        found = self._memory.formula(last, f"(key % {count} // {self.modes})")
        found = found if self.modes == 1 else f"({found}) * {self.modes} + mode"
        lines = [f"down = {down}", f"across = {across}", f"key = cell * {count} + {found}"]
        return {"key_start": start, "key_next": "; ".join(lines)}

    def contexts(self, keys: Any) -> list[tuple[Any, int]]:
        """Parts that `keys` share with others, from the coarsest to the finest: numbers below a count, and the count.

        Nothing (all keys alike), the last displacement, the whole memory but the cell, and last the key itself.
        """
        found: list[tuple[Any, int]] = [(keys * 0, 1)]
        found += self._memory.contexts(keys % self.num_classes // self.modes)
        if self.num_classes > 1:
            found.append((keys % self.num_classes, self.num_classes))
        return [*found, (keys, self.num_keys)]


def _number(rows: Any, columns: Any, clip: int) -> Any:
    """The number of a displacement."""
    return (rows.clip(-clip, clip) + clip) * (2 * clip + 1) + columns.clip(-clip, clip) + clip


def _clipped(number: str, clip: int) -> str:
    """Python for a number clipped to -clip ... clip."""
    return f"max(-{clip}, min({clip}, {number}))"
