"""Options and schemas: a dataclass field with help, unit and range and without a value; the base of every schema.

Values are in `conf/*.yaml` alone, types, units and ranges in the dataclasses of this package alone.
"""

from __future__ import annotations

import dataclasses
import re
import sys
import textwrap
import types
import typing
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import Field, dataclass
from functools import cache
from math import inf
from typing import Any, ClassVar, TypeAlias, TypeVar, dataclass_transform

from trackmdp.errors import UserError

_T = TypeVar("_T")

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
    ge: float = -inf
    gt: float = -inf
    le: float = inf
    lt: float = inf
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
        # YAML has words for infinite numbers and for nan. isfinite raises at integers of more digits than a float has.
        return not isinstance(value, (int, float)) or (
            abs(value) <= sys.float_info.max
            and self.ge <= value <= self.le
            and self.gt < value < self.lt
        )

    def _range(self) -> str:
        words = _KINDS.get(self.kind, str(self.kind))
        if -inf < self.ge and self.le < inf:
            return f"{words} from {_typed(self.ge)} to {_typed(self.le)}"
        signs = {">=": self.ge, ">": self.gt, "<=": self.le, "<": self.lt}
        limits = (f"{sign} {_typed(limit)}" for sign, limit in signs.items() if abs(limit) < inf)
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
    if isinstance(value, float) and value.is_integer() and "integer" not in expected:
        value = f"{value:.15g}"  # 400 was read as 400.0
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


GROUPS: dict[str, dict[str, type[Any]]] = {}
"""Group -> choice -> its schema, for example ``GROUPS["kernel"]["drift"]``."""


def typed_choices(group: str) -> list[str]:
    """The choices of a group but `given`, which stands for a problem made in Python and cannot be typed."""
    return [name for name in GROUPS.get(group, {}) if name != "given"]


@dataclass(frozen=True)
class Node:
    """A nested config.

    Attributes:
        schema: its dataclass; of a group the base of the choices.
        optional: whether it may be null.
        several: whether any number of choices may be made, as in ``log=[csv,mcap]``.
    """

    schema: type[Any]
    optional: bool
    several: bool


def nested(help: str) -> Any:
    """A dataclass field that is a config of its own, with a line for `--help` above its options."""
    return dataclasses.field(metadata={"nested": help})


BYTES = {"float32": 4, "int64": 8, "float64": 8, "int16": 2, "bool": 1}
"""Bytes of one number of each kind, for `needs`."""


Reasons: TypeAlias = dict[str, str]
"""Option without effect -> the reason."""
Needs: TypeAlias = dict[str, int]
"""Option -> bytes that grow with it."""


@dataclass_transform(
    kw_only_default=True,
    field_specifiers=(option, share_option, count_option, file_option, nested),
)
class NodeConfig:
    """Base of every schema. Each subclass becomes a dataclass with keywords only, without a decorator.

    A rule on one option is in its `option(...)`, a rule on several in `check`.
    """

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    def __init_subclass__(cls) -> None:
        dataclass(kw_only=True)(cls)

    def check(self, key: str, root: Any) -> None:
        """Check the rules between options of this node, and between them and the rest of the config.

        Args:
            key: of the node, such as ``algo``; messages name ``{key}.{option}``.
            root: the config of the command; its values are in range.

        Raises:
            UserError: a rule is broken.
        """

    def ignored(self, root: Any) -> Reasons:
        """Options of this node without effect on this config, and the reason: ``{"alpha": "with ...enabled=false"}``.

        They are refused if typed (`trackmdp.config.checks`).
        """
        return {}

    def needs(self, task: Any, root: Any) -> Needs:
        """Bytes that a run needs for this node, by the dotted option that they grow with.

        Args:
            task: of the run, `trackmdp.sensing.task.Task`.
            root: the config of the command.
        """
        return {}


class ChoiceConfig(NodeConfig):
    """Base of the config groups; `choice` gives each member its name and its maker."""

    name: ClassVar[str]
    makes: ClassVar[str]


def options(schema: type[Any]) -> dict[str, Option | Node]:
    """Fields of a schema in order: an `Option` for a value, a `Node` for a nested config."""
    return _fields(typing.cast(Any, schema))  # a class has a hash, which mypy does not know


@cache  # half of composing
def _fields(schema: Any) -> dict[str, Option | Node]:
    # The annotations are texts (`from __future__ import annotations`).
    hints = typing.get_type_hints(schema)
    found: dict[str, Option | Node] = {}
    for field in dataclasses.fields(schema):
        kind = hints[field.name]
        # `int | None` -> (int, True)
        if nullable := types.NoneType in typing.get_args(kind):
            kind = typing.get_args(kind)[0]
        several = typing.get_origin(kind) is dict and typing.get_args(kind)[1]
        described = field.metadata.get("option")
        if dataclasses.is_dataclass(several or kind):
            found[field.name] = Node(several or kind, nullable, bool(several))
        elif isinstance(described, Option):
            many = typing.get_origin(kind) is list
            kind = int if described.pair else typing.get_args(kind)[0] if many else kind
            found[field.name] = dataclasses.replace(
                described, kind=kind, many=many, nullable=nullable
            )
        else:
            raise TypeError(
                f"{schema.__name__}.{field.name} is neither option(...) nor a nested config"
            )
    return found


def several(schema: type[Any], name: str) -> bool:
    """Whether any number of choices may be made of the group `name`: ``log=[csv,mcap]``, none by ``log=[]``."""
    item = options(schema).get(name)
    return isinstance(item, Node) and item.several


def choice(group: str, name: str, *, makes: str) -> Callable[[type[_T]], type[_T]]:
    """Class decorator: make a schema the choice `name` of a config group.

    Args:
        group: ``kernel``, ``algo``, ``solver``, ...
        name: as typed: ``kernel=name``.
        makes: ``module:attribute`` of the code; imported when it is first used (`trackmdp.config.registry.maker`), so
            that a schema loads neither torch nor scipy.

    Raises:
        UserError: another schema has this name.
    """

    def register(schema: type[_T]) -> type[_T]:
        # The first comer stays: a plugin replaces no choice. The same class twice is a module imported again.
        known = GROUPS.setdefault(group, {}).setdefault(name, schema)
        if known is not schema:
            raise UserError(
                f"{group}={name}: offered by {known.__module__} and by {schema.__module__}"
            )
        schema.name, schema.makes = name, makes  # type: ignore[attr-defined]
        return schema

    return register


def nodes(cfg: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Every dataclass of a config with its dotted key, the outermost first."""
    yield prefix, cfg
    for name, value in vars(cfg).items():
        # A group of several holds a dict of its choices: log.csv, log.mcap.
        inner = value if isinstance(value, dict) else {"": value}
        for each, node in inner.items():
            if dataclasses.is_dataclass(node):
                yield from nodes(node, f"{prefix}.{name}.{each}".strip("."))


def leaves(cfg: Any, prefix: str = "") -> Iterator[tuple[str, Option, Any]]:
    """Every option of a config with its dotted key and its value."""
    for key, node in nodes(cfg, prefix):
        for name, item in options(type(node)).items():
            if isinstance(item, Option):
                yield f"{key}.{name}".lstrip("."), item, vars(node)[name]


def require_able(root: Any, ability: str, why: str) -> None:
    """Refuse a solver, a baseline or an algorithm that lacks an ability.

    Args:
        root: the config of the command.
        ability: a class attribute of the schemas of some of these groups, such as ``knows_budget``.
        why: ends the message, such as ``with cost.budget=2``.

    Raises:
        UserError: one lacks it; the message has the choices that do not.
    """
    for group in ("solver", "baseline", "algo"):
        chosen = getattr(root, group, None)
        if chosen is not None and not getattr(chosen, ability, True):
            able = [name for name, schema in GROUPS[group].items() if getattr(schema, ability)]
            raise refuse(group, chosen.name, f"one of {', '.join(able)} {why}")


def listed(names: Iterable[str]) -> str:
    """Choices in the form of the command line: ``[csv,mcap]``."""
    return f"[{','.join(names)}]"
