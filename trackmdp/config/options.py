"""The base of every schema; groups of choices; the options of a schema and of a config."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Callable, Iterable, Iterator
from dataclasses import Field, dataclass
from functools import cache
from typing import Any, ClassVar, TypeVar, dataclass_transform

from trackmdp.config.option_fields import (
    Option,
    count_option,
    file_option,
    option,
    refuse,
    share_option,
)
from trackmdp.errors import UserError

_T = TypeVar("_T")

GROUPS: dict[str, dict[str, type[Any]]] = {}
"""Group -> choice -> its schema, for example ``GROUPS["kernel"]["drift"]``."""


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

    def ignored(self, root: Any) -> dict[str, str]:
        """Options of this node without effect on this config, and the reason: ``{"alpha": "with ...enabled=false"}``.

        They are refused if typed (`trackmdp.config.checks`).
        """
        return {}

    def needs(self, task: Any, root: Any) -> dict[str, int]:
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
        kind, nullable = _without_none(hints[field.name])
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


def _without_none(hint: Any) -> tuple[Any, bool]:
    """``int | None`` -> (int, True)."""
    if typing.get_origin(hint) is not types.UnionType:
        return hint, False
    rest = [part for part in typing.get_args(hint) if part is not types.NoneType]
    return (rest[0], True) if len(rest) == 1 else (hint, False)


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
