"""What an option is, a dataclass field with its help, unit and range and no value, and what every schema has.

Values live in `conf/*.yaml` only; types, units and ranges live in the dataclasses of this package only.
"""

from __future__ import annotations

import dataclasses
import re
import sys
import types
import typing
from collections.abc import Iterator
from dataclasses import Field, dataclass
from typing import Any, ClassVar, TypeVar, dataclass_transform

from trackmdp.errors import UserError

_T = TypeVar("_T")

GROUPS: dict[str, dict[str, type[Any]]] = {}
"""Group -> option of the group -> its dataclass, for example ``GROUPS["kernel"]["drift"]``."""

SELECTORS: dict[str, Selector] = {}
"""Name -> a group without options of its own, which only picks among those of another one."""

_KINDS: dict[Any, str] = {int: "an integer", float: "a number", bool: "true or false", str: "a text"}


@dataclass(frozen=True)
class Selector:
    """Picks, for some choices of `group`, which of its options they stand for; `choices` come with their help.

    Each option of the group has the choice that it stands for under the selector's name.
    """

    group: str
    about: str
    choices: dict[str, str]


@dataclass(frozen=True)
class Option:
    """Help, unit and allowed values of one field.

    Attributes:
        help: what it is, in a few words.
        unit: unit of the value, shown in brackets.
        ge, gt, le, lt: limits of the value.
        choices: the words allowed, for a text.
        expects: says in words what is allowed where type and range cannot.
        pattern: regular expression that a text must match as a whole.
        path: a text is a path, relative to where the command is typed.
        words: texts that are no path although others are.
        pair: a whole number, or a list of two; the field's type is ``Any``, as OmegaConf has no such union.
        kind: its type, and `nullable` whether null is allowed: `options` reads both off the field's annotation.
    """

    help: str
    unit: str = ""
    ge: float | None = None
    gt: float | None = None
    le: float | None = None
    lt: float | None = None
    choices: tuple[str, ...] = ()
    expects: str = ""
    pattern: str = ""
    path: bool = False
    words: tuple[str, ...] = ()
    pair: bool = False
    kind: Any = None
    nullable: bool = False

    @property
    def expected(self) -> str:
        """What a value must be, in words: ``an integer from 3 to 64 (cells)``."""
        words = self.expects or (f"one of {', '.join(self.choices)}" if self.choices else self._kind_in_range())
        words = f"a list, each {words}" if self._element else words
        words += ", or a pair of them" if self.pair else ""
        words += " or null" if self.nullable else ""
        return words + (f" ({self.unit})" if self.unit else "")

    def allows(self, value: Any) -> bool:
        """Whether `value` has the right type and lies in the range."""
        if value is None:
            return self.nullable
        if isinstance(value, dict):  # groups are mappings, options never; what an option holds may be of any kind
            return False
        if self._element:
            return isinstance(value, list) and len(value) > 0 and all(map(self._element.allows, value))
        if self.pair and isinstance(value, (list, tuple)):
            return len(value) == 2 and all(map(dataclasses.replace(self, pair=False).allows, value))
        # `cost.reward=10` is a number to whoever types it, but an int to YAML. `True` is an int to Python,
        # and no number.
        if self.kind is float and isinstance(value, int) and not isinstance(value, bool):
            value = as_float(value)
        # `type`, not isinstance: True would pass as the integer 1.
        if self.kind in _KINDS and type(value) is not self.kind:
            return False
        if self.choices:
            return value in self.choices
        if self.pattern:
            return re.fullmatch(self.pattern, value) is not None
        return not isinstance(value, (int, float)) or self._in_range(value)

    @property
    def _element(self) -> Option | None:
        """What the elements must be, if this is a list."""
        if typing.get_origin(self.kind) is not list:
            return None
        # Range and choices of a list are those of its elements: list[int] with ge=1 holds positive
        # integers.
        return dataclasses.replace(self, kind=typing.get_args(self.kind)[0], nullable=False)

    def _in_range(self, value: float) -> bool:
        # Without this an option that has no upper bound would let .inf pass, and one that has no bound at
        # all .nan: YAML has words for both.
        # An integer may have more digits than a float can hold: isfinite would raise, comparisons are exact.
        return abs(value) <= sys.float_info.max and (
            (self.ge is None or value >= self.ge)
            and (self.gt is None or value > self.gt)
            and (self.le is None or value <= self.le)
            and (self.lt is None or value < self.lt)
        )

    def _kind_in_range(self) -> str:
        kind = _KINDS.get(self._element.kind if self._element else self.kind, str(self.kind))
        if self.ge is not None and self.le is not None:
            return f"{kind} from {_told(self.ge)} to {_told(self.le)}"
        signs = ((">=", self.ge), (">", self.gt), ("<=", self.le), ("<", self.lt))
        limits = [f"{sign} {_told(limit)}" for sign, limit in signs if limit is not None]
        return " ".join([kind, " and ".join(limits)]).strip()


def _told(limit: float) -> str:
    """A limit as one would type it: 1e6, not 1e+06."""
    return re.sub(r"e\+0*", "e", f"{limit:g}")


def option(help: str, **described: Any) -> Any:
    """A dataclass field without a default, described as an `Option` for `--help` and for `validate`."""
    return dataclasses.field(metadata={"option": Option(help, **described)})


def nested(help: str) -> Any:
    """A dataclass field that is a config of its own, with what `--help` says above its options."""
    return dataclasses.field(metadata={"nested": help})


BYTES = {"float32": 4, "int64": 8, "float64": 8, "int16": 2, "bool": 1}
"""Bytes of one number of each kind, for `needs`."""


@dataclass(frozen=True)
class Sizes:
    """What `needs` may know of a task, as `trackmdp.world.model.Task` has it.

    Attributes:
        num_cells: M.
        num_sensors: K.
        t_max: T_max.
        num_choices: t_max + 1.
        num_keys: plans of a policy.
        keyed: whether a key is more than the cell.
        order: detections before the last one that are remembered.
        markov: whether moves of different paths combine.
        pair_bytes: that exact evaluation over pairs of a key and a mode takes; 0 where there is none.
    """

    num_cells: int
    num_sensors: int
    t_max: int
    num_choices: int
    num_keys: int
    keyed: bool
    order: int
    markov: bool
    pair_bytes: int


@dataclass_transform(kw_only_default=True, field_specifiers=(option, nested))
class NodeConfig:
    """Base of every schema, each a dataclass with keywords only, whose decorator it need not have.

    A rule on one option is its `option(...)`; what concerns several is said here.
    """

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    def __init_subclass__(cls) -> None:
        dataclass(kw_only=True)(cls)

    def check(self, key: str, root: Any) -> None:
        """Look after the rules between options of this node, and between them and those of the whole config.

        Args:
            key: where the node stands, such as ``algo``; what is refused is named ``{key}.{option}``.
            root: the config of the command; its values have passed their own checks.

        Raises:
            UserError: a rule is broken.
        """

    def ignored(self, root: Any) -> dict[str, str]:
        """Options of this node without effect on this config, and why: ``{"alpha": "with algo.prioritized..."}``.

        They are refused where they were typed (`trackmdp.config.checks`).
        """
        return {}

    def needs(self, task: Sizes, root: Any) -> dict[str, int]:
        """Bytes that a run needs for what this node asks for, by the dotted option that they grow with."""
        return {}


class ChoiceConfig(NodeConfig):
    """Base of the config groups; `choice` gives each member its name and what it makes."""

    name: ClassVar[str]
    makes: ClassVar[str]


def options(schema: type[Any]) -> dict[str, Option | type[Any]]:
    """Fields of a schema in order: an `Option` for a value, the dataclass (or group base) for a nested config.

    A group of which any number of choices may be made is a ``dict[str, Base]`` and found as its ``Base``; `several`
    tells it from the others.
    """
    # `from __future__ import annotations` leaves the annotations as text; this evaluates them.
    hints = typing.get_type_hints(schema)
    found: dict[str, Option | type[Any]] = {}
    for field in dataclasses.fields(schema):
        kind, nullable = _strip_none(hints[field.name])
        kind = _element_of(kind) or kind
        described = field.metadata.get("option")
        if dataclasses.is_dataclass(kind) and isinstance(kind, type):
            found[field.name] = kind
        elif isinstance(described, Option):
            kind = int if described.pair else kind
            found[field.name] = dataclasses.replace(described, kind=kind, nullable=nullable)
        else:
            raise TypeError(f"{schema.__name__}.{field.name} is neither option(...) nor a nested config")
    return found


def optional(schema: type[Any], name: str) -> bool:
    """Whether the field `name`, a choice or a nested config, may be null."""
    return _strip_none(typing.get_type_hints(schema).get(name))[1]


def several(schema: type[Any], name: str) -> bool:
    """Whether any number of choices may be made of the group `name`: ``log=[csv,mcap]``, none by ``log=[]``."""
    return _element_of(_strip_none(typing.get_type_hints(schema).get(name))[0]) is not None


def choice(group: str, name: str, *, makes: str) -> typing.Callable[[type[_T]], type[_T]]:
    """Class decorator: make a dataclass the choice `name` of a config group.

    Args:
        group: ``kernel``, ``algo``, ``solver``, ...
        name: what is typed: ``kernel=name``.
        makes: ``module:attribute`` of what the choice stands for; imported when it is first made
            (`trackmdp.config.registry.maker`), so that a schema loads neither torch nor scipy.

    Raises:
        UserError: another schema has this name.
    """

    def register(schema: type[_T]) -> type[_T]:
        # setdefault keeps the first comer, so that a plugin cannot replace a choice by registering its name
        # once more; registering the very same class twice (a module imported again) does no harm.
        known = GROUPS.setdefault(group, {}).setdefault(name, schema)
        if known is not schema:
            raise UserError(f"{group}={name}: offered by {known.__module__} and by {schema.__module__}")
        schema.name, schema.makes = name, makes  # type: ignore[attr-defined]
        return schema

    return register


def choices_of(group: str) -> typing.Iterable[str]:
    """The names that may be chosen from a group or by a selector."""
    return SELECTORS[group].choices if group in SELECTORS else GROUPS[group]


def nodes(cfg: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Every dataclass of a config with its dotted key, the outermost first."""
    yield prefix, cfg
    for name, value in vars(cfg).items():
        # A group of several holds a dict of its choices: log.csv, log.mcap.
        inner = {f"{name}.{each}": node for each, node in value.items()} if isinstance(value, dict) else {name: value}
        for key, node in inner.items():
            if dataclasses.is_dataclass(node):
                yield from nodes(node, f"{prefix}.{key}".lstrip("."))


def leaves(cfg: Any, prefix: str = "") -> Iterator[tuple[str, Option, Any]]:
    """Every option of a config with its dotted key and its value."""
    for key, node in nodes(cfg, prefix):
        for name, described in options(type(node)).items():
            if isinstance(described, Option):
                yield f"{key}.{name}".lstrip("."), described, vars(node)[name]


def as_float(value: int) -> float:
    """An integer given for a number; one beyond the largest float stays as it is, and is refused for its type."""
    return float(value) if abs(value) <= sys.float_info.max else value


def refuse(key: str, value: object, expected: str) -> UserError:
    """The error for a value that is not allowed."""
    return UserError(f"{key}={'null' if value is None else value}: expected {expected}")


def listed(names: typing.Iterable[str]) -> str:
    """Choices as they are typed: ``[csv,mcap]``."""
    return f"[{','.join(names)}]"


def _element_of(kind: Any) -> type[Any] | None:
    """What each of ``dict[str, Base]`` is: ``Base``; None for any other type."""
    if typing.get_origin(kind) is not dict:
        return None
    element = typing.get_args(kind)[1]
    return element if isinstance(element, type) and dataclasses.is_dataclass(element) else None


def _strip_none(hint: Any) -> tuple[Any, bool]:
    # `Optional[int]` has the origin typing.Union, `int | None` has types.UnionType.
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        rest = [part for part in typing.get_args(hint) if part is not type(None)]
        if len(rest) == 1:
            return rest[0], True
    return hint, False
