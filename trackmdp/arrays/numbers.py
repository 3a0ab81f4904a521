"""Checks of numbers per cell or sensor."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
from scipy import sparse

from trackmdp.arrays.entries import short_indices
from trackmdp.arrays.types import Array, BoolArray
from trackmdp.config.sensors import LARGEST_PRICE
from trackmdp.errors import UserError

Range: TypeAlias = tuple[Callable[[Array], BoolArray], str]
"""A test of numbers, and its range in words."""

REAL = (int, float, np.integer, np.floating)
"""Kinds of a real number."""
PRICES: Range = (
    lambda price: np.isnan(price) | ((price >= 0) & (price <= LARGEST_PRICE)),
    "a number from 0 to 1e15, or nan where there is no sensor",
)
PROBABILITIES: Range = (lambda p: (p > 0) & (p <= 1), "a probability above 0, at most 1")


def array_of(source: str, given: Any) -> Any:
    """A table of any kind as an array, a sparse one as it is.

    Raises:
        UserError: its rows have different lengths; `source` is named at the start of the message.
    """
    try:
        return given if sparse.issparse(given) else np.asarray(given)
    except ValueError:
        raise UserError(f"{source}: rows of different lengths, expected a table") from None


def canonical(source: str, given: Any, expected: str = "a table") -> sparse.csr_array:
    """A table, sparse or dense, as CSR of float64 with sorted indices, no duplicates and no explicit zeros.

    Raises:
        UserError: it is no table of real numbers, or its indices lead out of it; `source` is named at the start.
    """
    table = array_of(source, given)
    # bool, signed, unsigned, float: complex numbers would lose their imaginary part below.
    if table.dtype.kind not in "biuf":
        raise UserError(f"{source}: not a table of numbers (but of {table.dtype})")
    if table.ndim != 2:
        raise UserError(f"{source}: expected {expected}, got shape {table.shape}")
    found = sparse.csr_array(table, dtype=np.float64, copy=True)
    # SciPy reads outside its memory where an index is wrong.
    try:
        found.check_format(full_check=True)
    except ValueError as error:
        raise UserError(f"{source}: not a sparse matrix ({error})") from None
    found.sum_duplicates()
    found.eliminate_zeros()
    return short_indices(found)


def one_each(
    source: str, given: npt.ArrayLike, count: int | tuple[int, int], each: str, allowed: Range
) -> Array:
    """`[count]` numbers, from one for all or from one for each.

    Args:
        source: beginning of each message.
        given: a number, or a list.
        count: how many there are to be; of rows and columns their product, and the numbers may be `[rows, columns]`.
        each: name of one item: a cell, or a sensor.
        allowed: which of some numbers are in range, and the range in words.

    Raises:
        UserError: another number of numbers, or one out of range.
    """
    try:
        if np.iscomplexobj(given):  # would lose their imaginary part
            raise TypeError
        values, rows = np.asarray(given, np.float64), ""
    except (TypeError, ValueError):
        raise UserError(f"{source}: {given!r:.40}, expected numbers") from None
    if isinstance(count, tuple):
        rows = f", or {count[0]} x {count[1]}"
        values = values.ravel() if values.shape == count else values
        count = math.prod(count)
    if values.shape not in ((), (count,)):
        table = " x ".join(map(str, values.shape)) + " numbers"
        found = f"{values.size} values" if values.ndim < 2 else table
        raise UserError(f"{source}: {found}, expected one number or {count} (one per {each}){rows}")
    within, expected = allowed
    if not (fine := np.asarray(within(values))).all():
        bad = int(np.flatnonzero(~fine)[0])
        raise UserError(f"{source}: {each} {bad} has {values.flat[bad]:.15g}, expected {expected}")
    return np.broadcast_to(values, (count,)).copy()


def whole_number(name: str, value: Any, lowest: int, most: float = math.inf) -> int:
    """A value that is an integer in its range; else a `UserError` with its name."""
    try:
        # False is 0 to Python: report(False) would be a detection in cell 0.
        number = None if isinstance(value, bool) else operator.index(value)
    except TypeError:
        number = None
    if number is None or not lowest <= number <= most:
        expected = f">= {lowest}" if most == math.inf else f"from {lowest} to {most:,}"
        # Quoted, as "5" may be one that a table of texts held.
        shown = repr(value) if isinstance(value, str) else value
        raise UserError(f"{name}={shown}: expected an integer {expected}")
    return number
