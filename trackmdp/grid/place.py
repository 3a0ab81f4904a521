"""Geography of a grid: the projection of its positions, its corner and the side of its cells."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from trackmdp.config.world import CRS_CODE
from trackmdp.errors import UserError, require
from trackmdp.untrusted import reason


@dataclass(frozen=True)
class Place:
    """Where a grid lies: on a map, or in the x and y of the positions.

    Attributes:
        corner: x and y of the corner with the smallest coordinates, in metres of the projection or units of x and y.
        cell: side of a cell, in the same unit.
        crs: code of the projection to metres of positions as (lat, lon); None: positions are (x, y).
        downwards: whether y points down, as in pictures: row 0 then has the smallest y, else the largest.

    Raises:
        UserError: a value is no number, or the code no projection.
    """

    corner: tuple[float, float]
    cell: float
    crs: str | None = None
    downwards: bool = False

    def __post_init__(self) -> None:
        left, low = (float(each) for each in self.corner)
        given = {"corner": (left, low), "cell": float(self.cell), "downwards": bool(self.downwards)}
        for name, value in given.items():
            object.__setattr__(self, name, value)  # the dataclass is frozen
        if not (math.isfinite(left) and math.isfinite(low) and 0 < self.cell < math.inf):
            raise UserError(
                f"place: corner {self.corner}, cell {self.cell}; expected numbers, a cell above 0"
            )
        if self.crs is not None and not re.fullmatch(CRS_CODE, self.crs):
            raise UserError(f"place: crs {self.crs[:40]!r}, expected a code such as EPSG:2056")

    @classmethod
    def of(
        cls, cell: float | None, origin: Sequence[float] | None, crs: str | None
    ) -> Place | None:
        """The place of a grid by hand; None where no side of a cell or no corner is given.

        Args:
            cell: side of a cell.
            origin: the corner, (x, y), or (lon, lat) with a `crs`.
            crs: see the class.

        Raises:
            UserError: the projection is not known, or does not reach the corner.
        """
        if cell is None or origin is None:
            return None
        return cls(projected(crs, origin), cell, crs)

    @property
    def axes(self) -> str:
        """The names of a position's two numbers."""
        return "x, y" if self.crs is None else "lat, lon"

    def cells(
        self, x: npt.ArrayLike, y: npt.ArrayLike, size: tuple[int, int]
    ) -> npt.NDArray[np.int64]:
        """`[S]` the cell of each x and y, as of `corner`; -1 outside of the grid of `size` rows and columns.

        Example: with corner (0, 0), cells of 10 and a 2 x 3 grid, (25, 5) is in column 2 and, y upwards, in the lower
        row: cell 1 · 3 + 2 = 5. (30, 5) is outside: a cell has its left and lower edges, not the others.
        """
        rows, columns = size
        # inf, where the projection does not reach
        with np.errstate(invalid="ignore", over="ignore"):
            column, up = (
                np.floor((np.asarray(each) - low) / self.cell)
                for each, low in zip((x, y), self.corner, strict=True)
            )
            inside = (column >= 0) & (column < columns) & (up >= 0) & (up < rows)
            # Compared as floats: integers made of inf or nan first would be any number at all.
            row = up if self.downwards else rows - 1 - up
            found = np.where(inside, row * columns + column, -1.0)
        return found.astype(np.int64)

    def cell_of(self, position: tuple[float, float], size: tuple[int, int]) -> int:
        """The cell of a position (lat, lon) or (x, y).

        Raises:
            UserError: it is outside of the grid, or no two numbers.
        """
        try:
            first, second = (float(each) for each in position)
        except (TypeError, ValueError, OverflowError):
            raise UserError(f"cell_of: {position!r:.80}, expected {self.axes} as numbers") from None
        x, y = first, second
        if self.crs is not None:
            # A user's order is (lat, lon), that of a projection always (lon, lat).
            x, y = projection(self.crs).transform(second, first)
        cell = int(self.cells(x, y, size))
        if cell < 0:
            raise UserError(
                f"cell_of: {self.axes} = {first:g}, {second:g} is outside of the grid; its middle is "
                f"{'{:g}, {:g}'.format(*self._position(size[1] / 2, size[0] / 2))}"
            )
        return cell

    def place_of(self, cell: int, size: tuple[int, int]) -> tuple[float, float]:
        """The position, (lat, lon) or (x, y), of the middle of a cell."""
        row, column = divmod(cell, size[1])
        up = row if self.downwards else size[0] - 1 - row
        return self._position(column + 0.5, up + 0.5)

    def outline(self, cell: int, size: tuple[int, int]) -> list[tuple[float, float]]:
        """The positions of the corners of a cell, counterclockwise from the lower left one."""
        row, column = divmod(cell, size[1])
        low = row if self.downwards else size[0] - 1 - row
        corners = ((0, 0), (1, 0), (1, 1), (0, 1))
        return [self._position(column + right, low + up) for right, up in corners]

    def _position(self, across: float, up: float) -> tuple[float, float]:
        """The position so many cells from the corner."""
        x, y = self.corner[0] + across * self.cell, self.corner[1] + up * self.cell
        if self.crs is None:
            return x, y
        lon, lat = projection(self.crs).transform(x, y, direction="INVERSE")
        return float(lat), float(lon)

    def facts(self) -> dict[str, Any]:
        """The attributes, as JSON takes them."""
        return asdict(self) | {"corner": list(self.corner)}

    def recipe(self, size: tuple[int, int]) -> dict[str, str]:
        """The attributes as texts, and the formula of a cell for readers without this package, as lines of Python."""
        (left, low), (rows, columns) = self.corner, size
        up = f"floor((y - {low!r}) / {self.cell!r})"
        row = up if self.downwards else f"{rows - 1} - {up}"
        column = f"column = floor((x - {left!r}) / {self.cell!r})"
        # repr, not a format: a reader comes to the same cell only with all digits.
        return {
            "crs": self.crs or "",
            "corner": f"{left!r}, {low!r}",
            "cell_side": repr(self.cell),
            "cell_of": f"{column}; row = {row}; cell = row * {columns} + column",
        }


def projected(crs: str | None, origin: Sequence[float]) -> tuple[float, float]:
    """The corner (lon, lat) of a grid in metres of a projection; without one it is in x and y already.

    Raises:
        UserError: the projection is not known, or does not reach there.
    """
    x, y = origin if crs is None else projection(crs).transform(*origin)
    if not (math.isfinite(x) and math.isfinite(y)):
        raise UserError(
            f"grid.origin={list(origin)}: outside of {crs}, expected lon, lat within it"
        )
    return float(x), float(y)


# To make one is to look it up in a database, and each position on a map asks for it.
@lru_cache(maxsize=8)
def projection(code: str) -> Any:
    """The transformer of pyproj from (lon, lat) to x and y in metres.

    Raises:
        UserError: the code is of no known projection, or of one in other units; pyproj is not installed.
    """
    require("pyproj", "tracks", f"grid.crs={code}")
    from pyproj import CRS, Transformer
    from pyproj.exceptions import ProjError

    try:
        crs = CRS.from_user_input(code)
        units = {axis.unit_name for axis in crs.axis_info}
        if not crs.is_projected or units != {"metre"}:
            raise UserError(
                f"grid.crs={code}: {crs.name}, expected a projected coordinate system in metres"
            )
        return Transformer.from_crs("EPSG:4326", crs, always_xy=True)
    except ProjError as error:
        raise UserError(f"grid.crs={code}: no known coordinate system ({reason(error)})") from None
