"""Choices of a group: their code, their file of values, and the choices that installed packages add.

A kernel, an algorithm, a solver, a baseline, a collector or a logger is three files, in this package or outside:

* code, such as ``def levy(size, *, alpha, exit_probability): ...`` in ``trackmdp_levy/flight.py``;
* a schema, such as ``@choice("kernel", "levy", makes="trackmdp_levy.flight:levy")`` in ``trackmdp_levy/__init__.py``;
* values, here ``trackmdp_levy/conf/kernel/levy.yaml``, which begins with ``defaults: [base_levy]``
  (of a logger with a line ``# @package log.levy`` before it, since any number of them are chosen together).

An outside package names the module of its schemas in its ``pyproject.toml``; ``conf/`` is beside that module::

    [project.entry-points."trackmdp.plugins"]
    levy = "trackmdp_levy"
"""

from __future__ import annotations

import copy
import importlib
import importlib.metadata
import math
import os
from collections.abc import Callable, Sequence
from functools import lru_cache
from operator import attrgetter
from pathlib import Path
from typing import Any

from omegaconf import AnyNode, DictConfig, OmegaConf
from omegaconf.errors import (
    InterpolationToMissingValueError,
    OmegaConfBaseException,
)

from trackmdp.config.learning import MOST_FRAMES
from trackmdp.config.options import GROUPS, ChoiceConfig
from trackmdp.errors import UserError, message_of

ENTRY_POINTS = "trackmdp.plugins"
_FEW = 100


def maker(node: ChoiceConfig | type[ChoiceConfig]) -> Callable[..., Any]:
    """The code of a choice, imported now: the function of a kernel, the class of a learner, ...

    Raises:
        UserError: there is no such module, or no such name in it.
    """
    module, _, attribute = node.makes.partition(":")
    try:
        # The attribute may be a method: `trackmdp.policies.policy:Policy.random_k`.
        return attrgetter(attribute)(importlib.import_module(module))
    except (ImportError, AttributeError) as error:
        raise UserError(f"{node.name}: cannot be made, {node.makes}: {error}") from error


def make(node: ChoiceConfig, *args: Any, **more: Any) -> Any:
    """Call the code of a choice with `args`, the options of the choice by name, and `more`."""
    # By attribute, so that a test can record the options that are read.
    given = {name: getattr(node, name) for name in vars(node)}
    return maker(node)(*args, **given, **more)


@lru_cache(maxsize=1)
def load_plugins() -> tuple[Path, ...]:
    """Import every installed package with an entry point `trackmdp.plugins`; only the first call does.

    Returns:
        The packages' `conf/` folders.

    Raises:
        UserError: a plugin cannot be imported, or has no values for one of its choices.
    """
    folders = []
    # By name: the order of installation must not decide anything.
    for entry in sorted(
        importlib.metadata.entry_points(group=ENTRY_POINTS), key=lambda each: each.name
    ):
        known = {(group, name) for group, members in GROUPS.items() for name in members}
        try:
            module = entry.load()  # registers its choices
            folders.append(Path(module.__file__).parent / "conf")
        except (Exception, SystemExit) as error:  # of any kind, from a module of others
            package = entry.dist.name if entry.dist else entry.value
            raise UserError(
                f"plugin {entry.name} of {package}: cannot be loaded ({type(error).__name__}: {error}); "
                "repair it or uninstall it"
            ) from error
        for group, name in {(g, n) for g, members in GROUPS.items() for n in members} - known:
            # Else Hydra would report it as a missing file of ours, and only once the choice is typed.
            if not (file := folders[-1] / group / f"{name}.yaml").is_file():
                raise UserError(f"plugin {entry.name}: no {file} with the values of {group}={name}")
    return tuple(folders)


def conf_dir() -> str:
    """The folder of the YAML files: `$TRACKMDP_CONF`, the `conf/` of a clone, or the copy inside the wheel.

    Raises:
        UserError: none of them has a `train.yaml`.
    """
    package, chosen = Path(__file__).resolve().parents[1], os.environ.get("TRACKMDP_CONF")
    # Beside an installed package a folder `conf` may be anybody's; a clone has a pyproject.toml there.
    clone = [package.parent / "conf"] if (package.parent / "pyproject.toml").is_file() else []
    for folder in [Path(chosen)] if chosen else [*clone, package / "conf"]:
        if (folder / "train.yaml").is_file():
            return str(folder.resolve())
    raise UserError(f"TRACKMDP_CONF={chosen or ''}: expected a folder with train.yaml")


def read_values(name: str) -> dict[str, Any]:
    """The values of a file of `conf/` or of a plugin, such as ``kernel/drift``, with interpolations as they stand.

    Raises:
        UserError: there is no such file.
    """
    # Our own folder first: a plugin adds choices, and replaces none of our values.
    for folder in (Path(conf_dir()), *load_plugins()):
        if (file := folder / f"{name}.yaml").is_file():
            # A copy: callers change it. The time of the last change is part of the key of the cache.
            return copy.deepcopy(_load(file, file.stat().st_mtime_ns))
    raise UserError(f"{name}: no such config")


@lru_cache(maxsize=128)  # parsing is nine tenths of composing
def _load(file: Path, stamp: int) -> dict[str, Any]:  # noqa: ARG001
    plain: Any = OmegaConf.to_container(OmegaConf.load(file))
    return {str(key): value for key, value in plain.items()}


def choice_values(group: str, name: str) -> dict[str, Any]:
    """The values of one choice."""
    values = read_values(f"{group}/{name}")
    for entry in values.pop("defaults"):
        if isinstance(entry, dict):  # {"/baseline@_here_": "qmdp"}: the file of another group
            values = choice_values(next(iter(entry)).strip("/").split("@")[0], name) | values
    return values


def unresolved(values: dict[str, Any]) -> DictConfig:
    """The values, nested by key, as a config of OmegaConf."""
    return OmegaConf.create(_wrapped(values))


def resolved(values: dict[str, Any] | DictConfig) -> dict[str, Any]:
    """The values with every ``${...}`` replaced; ``???`` stays.

    Raises:
        UserError: an interpolation leads nowhere, or a value is of no kind that a file has.
    """
    register_resolvers()
    try:
        config = values if isinstance(values, DictConfig) else unresolved(values)
        plain: Any = OmegaConf.to_container(config, resolve=True)
    except OmegaConfBaseException as error:
        # Its further lines (full_key, object_type) are about OmegaConf.
        if isinstance(error, InterpolationToMissingValueError):
            key = message_of(error).rpartition(" ")[2]
            needed = f", expected {key}=NAME" if key in GROUPS else ""
            raise UserError(f"{key}: missing{needed}") from error
        where = f"{error.full_key}: " if error.full_key else ""
        raise UserError(f"{where}{message_of(error)}") from error
    return dict(plain)


class _Numbers(list[float]):
    """A list that OmegaConf takes as one value: a node for each of a million prices would take more than a minute."""

    def __deepcopy__(self, memo: object) -> _Numbers:
        return self


def _wrapped(value: Any) -> Any:
    """`value` with its lists of more than `_FEW` numbers as nodes without children."""
    if isinstance(value, dict):
        return {key: _wrapped(item) for key, item in value.items()}
    if not isinstance(value, list) or len(value) <= _FEW:
        return value
    numbers = all(type(each) in (int, float) for each in value)
    return AnyNode(_Numbers(value), flags={"allow_objects": True}) if numbers else value


def register_resolvers() -> None:
    """Register `${first:a,b}`, the first value that is not null, and `${per_cell:count,size,least}`."""
    # replace: resolvers are global to the process, and a name cannot be registered twice.
    OmegaConf.register_new_resolver(
        "first", lambda *values: next((v for v in values if v is not None), None), replace=True
    )
    OmegaConf.register_new_resolver("per_cell", _per_cell, replace=True)


def _per_cell(count: float, size: Any, least: int = 0) -> int:
    """`count` for each cell of a grid of N x N cells, or of [rows, columns]; `least` in all.

    A fraction is rounded up to a multiple of `least`: .2 for each of 110 x 110 cells, 2420 in all, is 3000 with least
    1000.
    """
    sides = size if isinstance(size, Sequence) else (size, size)
    if not all(isinstance(side, int) for side in sides):
        return max(math.ceil(count), least)  # the check of the size itself follows
    if isinstance(count, int):
        # Of a grid too large for the memory the size is refused, not an option that follows from it.
        return min(max(count * math.prod(sides), least), MOST_FRAMES)
    # Rounded before it is rounded up: .2 · M / 1000 and M / 5000 have to agree to the last bit.
    return max(math.ceil(round(count * math.prod(sides) / least, 9)), 1) * least
