"""What a policy remembers at a detection: a key, from which its plan of sets is read until the next detection.

A key is the located cell and a class of what came before it, numbered cell · C + class, with C classes. Class 0 stands
for nothing: it is that of an episode's start, and with `cell`, the paper's policies, the only one. Where a detection
tells the target's mode (`kernel.reveals`) nothing before it matters, and the class is the mode.

A displacement is kept up to `clip` rows and columns, larger ones count as that; its number is that of a window of
2 · clip + 1 rows and columns. With clip 1, one row down and two columns to the right is clipped to (1, 1), and has the
number (1 + 1) · 3 + (1 + 1) = 8.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class KeySpace:
    """The keys of a task. All methods take NumPy arrays or tensors of int64, of any one shape.

    Attributes:
        size: (rows, columns) of the grid.
        t_max: T_max; a detection comes after 0 ... t_max + 1 misses.
        memory: one of `trackmdp.config.world.MEMORIES`: the cell; and the displacement since the detection before; and
            the misses between the two; or the last two displacements, of the earlier one the direction alone (clip 1).
        clip: rows and columns up to which displacements are told apart.
        modes: that a detection tells apart, and then `memory` is "cell"; 1 where it tells the cell alone.
    """

    size: tuple[int, int]
    t_max: int
    memory: str
    clip: int
    modes: int = 1

    @property
    def order(self) -> int:
        """Detections before the last one on which a key depends."""
        return {"cell": 0, "two_displacements": 2}.get(self.memory, 1)

    @property
    def displacements(self) -> int:
        """Displacements told apart."""
        return (2 * self.clip + 1) ** 2

    @property
    def num_classes(self) -> int:
        """C, classes of what came before the last detection."""
        last = self.displacements
        # 1 for the start; after two_displacements' first detection there is one displacement, and the earlier one is
        # class 0 of the 9 directions and none.
        counts = {"cell": self.modes, "displacement": 1 + last, "displacement_gap": 1 + (self.t_max + 2) * last}
        return counts.get(self.memory, (1 + last) * 10)

    @property
    def num_keys(self) -> int:
        """M · C."""
        return self.size[0] * self.size[1] * self.num_classes

    def start(self, cells: Any, modes: Any = 0) -> Any:
        """Keys of an episode that starts located in `cells`, in `modes` where a detection tells them."""
        return cells * self.num_classes + (modes if self.modes > 1 else 0)

    def cell(self, keys: Any) -> Any:
        """The located cells of `keys`."""
        return keys // self.num_classes

    def next(self, keys: Any, misses: Any, cells: Any, modes: Any = 0) -> Any:
        """Keys after a detection in `cells`, the one before having left `keys`, with `misses` in between."""
        if self.memory == "cell":
            return self.start(cells, modes)
        before, columns = self.cell(keys), self.size[1]
        rows, across = cells // columns - before // columns, cells % columns - before % columns
        # number + 1, for 0 is the start
        last = _number(rows, across, self.clip) + 1
        if self.memory == "displacement_gap":
            last = last + misses * self.displacements
        if self.memory == "two_displacements":
            last = last * 10 + self._direction(keys % self.num_classes)
        return cells * self.num_classes + last

    def _direction(self, classes: Any) -> Any:
        """0 for none, else 1 + the number of the last displacement's direction, of what were the `classes` before."""
        last, side = classes // 10, 2 * self.clip + 1
        rows, across = (last - 1) // side - self.clip, (last - 1) % side - self.clip
        return (_number(rows, across, 1) + 1) * (last > 0)

    def contexts(self, keys: Any) -> list[tuple[Any, int]]:
        """What `keys` share with others, from the coarsest to the finest: numbers below a count, and the count.

        Nothing (all keys alike), the last displacement, all that is remembered but the cell, and last the key itself.
        """
        known = keys % self.num_classes
        found: list[tuple[Any, int]] = [(keys * 0, 1)]
        if self.memory == "two_displacements":
            found.append((known // 10, 1 + self.displacements))
        if self.memory == "displacement_gap":
            # Class 1 + gap · D + number: without the gap it is 1 + number; class 0 stays.
            found.append((((known - 1) % self.displacements + 1) * (known > 0), 1 + self.displacements))
        if self.num_classes > 1:
            found.append((known, self.num_classes))
        return [*found, (keys, self.num_keys)]


def _number(rows: Any, columns: Any, clip: int) -> Any:
    """The number of a displacement."""
    return (rows.clip(-clip, clip) + clip) * (2 * clip + 1) + columns.clip(-clip, clip) + clip
