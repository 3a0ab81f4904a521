"""Schema of sweeps: `hydra/sweeper` says which runs there are, `hydra/launcher` where they are run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar

from omegaconf import OmegaConf

from trackmdp.config.checks import leaves
from trackmdp.config.options import option, refuse
from trackmdp.errors import UserError

__all__ = ["PLUGINS", "Basic", "Blocks", "Launcher", "Sweeper", "plugin"]

T = TypeVar("T")

PLUGINS: dict[str, dict[str, type[Any]]] = {"launcher": {}, "sweeper": {}}
"""Group of `hydra` -> option of the group -> its dataclass."""


def _offered(group: str, name: str) -> Callable[[type[T]], type[T]]:
    """Class decorator: make a dataclass the option `name` of the group `hydra/<group>`."""

    def register(schema: type[T]) -> type[T]:
        schema.name = name  # type: ignore[attr-defined]
        PLUGINS[group][name] = schema
        return schema

    return register


def plugin(group: str, node: Any) -> Any:
    """The typed, checked options of `hydra.<group>`.

    Raises:
        UserError: a value is out of its range, or the option chosen is none of ours.
    """
    schema = OmegaConf.get_type(node)
    if schema not in PLUGINS[group].values():
        raise UserError(f"hydra/{group}: expected one of {', '.join(PLUGINS[group])}")
    typed = OmegaConf.to_object(node)
    for key, described, value in leaves(typed, f"hydra.{group}."):
        if not described.allows(value):
            raise refuse(key, value, described.expected)
    return typed


@dataclass(kw_only=True)
class Sweeper:
    """Base of the group `hydra/sweeper`: which runs a sweep has."""

    name: ClassVar[str]
    blocks: list[str] | None = option(
        "grids whose union is the sweep; null = one of the typed words", expects="a line of words"
    )


@_offered("sweeper", "blocks")
@dataclass(kw_only=True)
class Blocks(Sweeper):
    """Every combination of the values in each block; what is typed is added to each, or replaces its words."""


@dataclass(kw_only=True)
class Launcher:
    """Base of the group `hydra/launcher`: where the runs of a sweep take place."""

    name: ClassVar[str]


@_offered("launcher", "basic")
@dataclass(kw_only=True)
class Basic(Launcher):
    """One run after the other, on this machine."""
