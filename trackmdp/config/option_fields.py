"""An option: a dataclass field with help, unit and range and without a value; and the refusal of a value.

Values are in `conf/*.yaml` alone, types, units and ranges in the dataclasses of this package alone.
"""

from __future__ import annotations

import dataclasses
import re
import sys
import textwrap
import typing
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

from trackmdp.errors import UserError

_KINDS: dict[Any, str] = {
    int: "an integer",
    float: "a number",
    bool: "true or false",
    str: "a text",
}
TABLE = r".+\.(npy|npz|csv)"
"""Pattern of the path of a table of numbers."""


@dataclass(frozen=True)
class Option:
    """Help, unit and allowed values of one field.

    Attributes:
        help: meaning, in a few words.
        unit: unit of the value, shown in brackets.
        ge, gt, le, lt: limits of the value; of a list, of its elements.
        choices: the words allowed, for a text.
        expects: the allowed values in words, where type and range are not enough.
        pattern: regular expression that a text must match as a whole.
        path: a text is a path, relative to the current folder of the command.
        words: texts of such an option that are no path.
        pair: a whole number, or a list of two; the field's type is ``Any``, as OmegaConf has no such union.
        kind: type, of a list that of its elements; `options` reads it off the annotation of the field, as it does
            `many`, whether it is a list, and `nullable`, whether null is allowed.
    """

    help: str
    unit: str = ""
    ge: float | None = None
    gt: float | None = None
    le: float | None = None
    lt: float | None = None
    choices: Collection[str] = dataclasses.field(default=(), hash=False)
    expects: str = ""
    pattern: str = ""
    path: bool = False
    words: tuple[str, ...] = ()
    pair: bool = False
    kind: Any = None
    many: bool = False
    nullable: bool = False

    @property
    def expected(self) -> str:
        """The allowed values in words: ``an integer from 3 to 64 (cells)``."""
        words = self.expects
        if not words:
            words = f"one of {', '.join(self.choices)}" if self.choices else self._range()
        words = f"a list, each {words}" if self.many else words
        words += ", or a pair of them" if self.pair else ""
        words += " or null" if self.nullable else ""
        return words + (f" ({self.unit})" if self.unit else "")

    def allows(self, value: Any) -> bool:
        """Whether `value` has the right type and lies in the range."""
        if value is None:
            return self.nullable
        if isinstance(value, dict):
            return typing.get_origin(self.kind) is dict
        if isinstance(value, list) and (self.many or self.pair):
            one = dataclasses.replace(self, many=False, pair=False, nullable=False)
            right = len(value) == 2 if self.pair else bool(value)
            return right and all(map(one.allows, value))
        if self.many:
            return False
        # `cost.reward=10` is an integer to YAML.
        if self.kind is float and type(value) is int:
            value = as_float(value)
        # `type`, not isinstance: True would pass as the integer 1.
        if self.kind in _KINDS and type(value) is not self.kind:
            return False
        if self.path and value == "":  # else it would be the current folder
            return False
        if self.choices:
            return value in self.choices
        if self.pattern:
            return re.fullmatch(self.pattern, value) is not None
        return not isinstance(value, (int, float)) or self._in_range(value)

    def _in_range(self, value: float) -> bool:
        # YAML has words for infinite numbers and for nan. isfinite raises at integers of more digits than a float has.
        return abs(value) <= sys.float_info.max and (
            (self.ge is None or value >= self.ge)
            and (self.gt is None or value > self.gt)
            and (self.le is None or value <= self.le)
            and (self.lt is None or value < self.lt)
        )

    def _range(self) -> str:
        words = _KINDS.get(self.kind, str(self.kind))
        if self.ge is not None and self.le is not None:
            return f"{words} from {_typed(self.ge)} to {_typed(self.le)}"
        signs = {">=": self.ge, ">": self.gt, "<=": self.le, "<": self.lt}
        limits = (f"{sign} {_typed(limit)}" for sign, limit in signs.items() if limit is not None)
        return f"{words} {' and '.join(limits)}".strip()


def _typed(limit: float) -> str:
    """A limit in the form of the command line: 1e6, not 1e+06."""
    return re.sub(r"e\+0*", "e", f"{limit:g}")


def option(help: str, **described: Any) -> Any:
    """A dataclass field without a default, described as an `Option` for `--help` and for `validate`."""
    return dataclasses.field(metadata={"option": Option(help, **described)})


def share_option(help: str, **described: Any) -> Any:
    """An `option` of a number from 0 to 1."""
    return option(help, ge=0, le=1, **described)


def count_option(help: str, **described: Any) -> Any:
    """An `option` of a number from 1 on."""
    return option(help, ge=1, **described)


def file_option(help: str, expects: str, **described: Any) -> Any:
    """An `option` of a path, or of several."""
    return option(help, expects=expects, path=True, **described)


def as_float(value: int) -> float:
    """An integer given for a number; one beyond the largest float stays, and is refused for its type."""
    return float(value) if abs(value) <= sys.float_info.max else value


def refuse(key: str, value: object, expected: str) -> UserError:
    """The error for a value that is not allowed."""
    number = "number" in expected or "integer" in expected
    if number and isinstance(value, str) and is_number(value):
        # `seed=4: expected an integer` would contradict itself; from the environment comes text.
        how = '"${oc.decode:${oc.env:NAME}}"'  # quoted: Hydra's grammar has no braces in braces
        return UserError(
            f"{key}: the text '{value}', expected {expected} (from the environment: {how})"
        )
    text = "null" if value is None else " ".join(str(value).split())
    return UserError(
        f"{key}={textwrap.shorten(text, 200, placeholder=' ...')}: expected {expected}"
    )


def is_number(text: str) -> bool:
    """Whether a text reads as a number."""
    try:
        float(text)
    except ValueError:
        return False
    return True
