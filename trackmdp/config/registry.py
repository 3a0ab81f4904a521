"""What a choice of a config group makes, its file of values, and the choices that installed packages add.

A kernel, an algorithm, a solver, a baseline, a collector or a logger is three files, inside this package or outside:

* its code, such as ``def levy(size, *, alpha, exit_probability): ...`` in ``trackmdp_levy/flight.py``;
* its schema, such as ``@choice("kernel", "levy", makes="trackmdp_levy.flight:levy")`` in ``trackmdp_levy/__init__.py``;
* its values, here ``trackmdp_levy/conf/kernel/levy.yaml``, which begins with ``defaults: [base_levy]``
  (a logger's with a line ``# @package log.levy`` before it, since any number of them are chosen together).

An outside package says in its ``pyproject.toml`` which module holds the schemas; ``conf/`` is looked for beside it::

    [project.entry-points."trackmdp.plugins"]
    levy = "trackmdp_levy"
"""

from __future__ import annotations

import copy
import importlib
import importlib.metadata
import math
import os
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from operator import attrgetter
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from trackmdp.config.options import GROUPS, ChoiceConfig, options
from trackmdp.errors import UserError

ENTRY_POINTS = "trackmdp.plugins"


def maker(node: ChoiceConfig | type[ChoiceConfig]) -> Callable[..., Any]:
    """What a choice makes, imported now: the kernel's function, the learner's class, ...

    Raises:
        UserError: there is no such module, or nothing of this name in it.
    """
    module, _, attribute = node.makes.partition(":")
    try:
        # The attribute may be a method: `trackmdp.policies.policy:Policy.random_k`.
        return attrgetter(attribute)(importlib.import_module(module))
    except (ImportError, AttributeError) as error:
        # A missing third-party module inside ours is a bug or a missing extra, and keeps its own message.
        raise UserError(f"{node.name}: cannot be made, {node.makes}: {error}") from error


def make(node: ChoiceConfig, *args: Any, **more: Any) -> Any:
    """Call what a choice makes with `args`, the choice's own options by name, and `more`."""
    return maker(node)(*args, **{name: getattr(node, name) for name in options(type(node))}, **more)


@lru_cache(maxsize=1)
def load_plugins() -> tuple[Path, ...]:
    """Let every installed package that names itself under `trackmdp.plugins` add its choices; only the first call does.

    Returns:
        The packages' `conf/` folders.

    Raises:
        UserError: a plugin cannot be imported, or has no values for one of its choices.
    """
    folders = []
    # `name` sorts them: the order of installation must not decide anything.
    for entry in sorted(importlib.metadata.entry_points(group=ENTRY_POINTS), key=lambda each: each.name):
        # Importing the plugin registers its choices: what is in GROUPS afterwards and was not before is what it adds.
        known = {(group, name) for group, members in GROUPS.items() for name in members}
        try:
            module = entry.load()
        except Exception as error:  # whatever a stranger's module raises, it is told in one line
            package = entry.dist.name if entry.dist else entry.value
            raise UserError(
                f"plugin {entry.name} of {package}: cannot be loaded ({type(error).__name__}: {error}); "
                "mend it or uninstall it"
            ) from error
        folder = Path(module.__file__).parent / "conf"
        folders.append(folder)
        for group, name in {(group, name) for group, members in GROUPS.items() for name in members} - known:
            # Told now, and with the plugin's name: Hydra would tell it when the choice is typed, as a file of ours
            # that is missing.
            if not (folder / group / f"{name}.yaml").is_file():
                raise UserError(
                    f"plugin {entry.name}: no {folder / group / name}.yaml with the values of {group}={name}"
                )
    return tuple(folders)


def conf_dir() -> str:
    """The folder of the YAML files: `$TRACKMDP_CONF`, a clone's `conf/`, or the copy inside the wheel.

    Raises:
        UserError: none of them holds a `train.yaml`.
    """
    package, chosen = Path(__file__).resolve().parents[1], os.environ.get("TRACKMDP_CONF")
    # An installed package lies in site-packages, where a folder `conf` may be anybody's; a clone has a pyproject.toml
    # beside it.
    clone = package.parent / "conf" if (package.parent / "pyproject.toml").is_file() else None
    for folder in [Path(chosen)] if chosen else [clone, package / "conf"]:
        if folder is not None and (folder / "train.yaml").is_file():
            return str(folder.resolve())
    where = f"TRACKMDP_CONF={chosen}: expected a folder with" if chosen else "TRACKMDP_CONF is not set, and there is no"
    raise UserError(f"{where} train.yaml")


def conf_file(name: str) -> Path:
    """The file of a config, such as ``kernel/drift``: in `conf/`, else in a plugin's folder.

    Raises:
        UserError: there is none.
    """
    # Our own folder first: a plugin adds choices, it does not replace the values of ours.
    for folder in (Path(conf_dir()), *load_plugins()):
        if (file := folder / f"{name}.yaml").is_file():
            return file
    raise UserError(f"{name}: no such config")


def choice_values(group: str, name: str, chosen: Mapping[str, Any]) -> dict[str, Any]:
    """The values of one choice with its `name`, its defaults list followed."""
    # Example: algo=ppo credit=per_sensor. conf/algo/ppo.yaml names /credit@_here_: '${credit}/ppo', hence
    # conf/credit/per_sensor/ppo.yaml, whose own list names /algo/base_ppo_per_sensor@_here_: the choice's name
    # is ppo_per_sensor.
    values = read_values(f"{group}/{name}")
    merged: dict[str, Any] = {}
    for entry in values.pop("defaults", []):
        if isinstance(entry, str):  # base_ppo, or /algo/base_ppo@_here_: the schema
            merged["name"] = entry.split("/")[-1].split("@")[0].removeprefix("base_")
            continue
        for target, other in entry.items():  # {/credit@_here_: '${credit}/ppo'}
            for selector, selected in chosen.items():
                other = other.replace(f"${{{selector}}}", str(selected))
            merged |= choice_values(target.strip("/").split("@")[0], other, chosen)
    # The file's own values win over those of its defaults list, as in Hydra (1.1 and later) without `_self_`.
    return merged | values


def resolved(values: dict[str, Any], known: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """The values with every ``${...}`` replaced by what it stands for; `prefix` goes before a key in messages."""
    register_resolvers()
    try:
        config = OmegaConf.create(values)
        # Looked for before resolving, which would leave `???` in place; sorted, since a set names another key at
        # each call.
        for key in sorted(OmegaConf.missing_keys(config)):
            raise UserError(
                f"{prefix}{key}: missing, expected {known[key].expected if key in known else f'{key}=NAME'}"
            )
        # Resolved last: `${algo.total_frames}` in the collector must stand for the value that was given,
        # not for the default.
        plain: Any = OmegaConf.to_container(config, resolve=True)
    except OmegaConfBaseException as error:
        # OmegaConf's further lines (full_key, object_type) are of no use to whoever typed the option.
        raise UserError(str(error).splitlines()[0]) from error
    return dict(plain)


def read_values(name: str) -> dict[str, Any]:
    """A file of `conf/`, uninterpreted."""
    file = conf_file(name)
    # A copy, since the callers pop and set keys, and the cached dict is shared by every later call. The time of
    # the last change is part of the cache's key, so that an edited file is read again.
    return copy.deepcopy(_load(file, file.stat().st_mtime_ns))


@lru_cache(maxsize=128)  # parsing is nine tenths of composing
def _load(file: Path, stamp: int) -> dict[str, Any]:  # noqa: ARG001  (the stamp tells a file from what it was before)
    plain: Any = OmegaConf.to_container(OmegaConf.load(file))
    # YAML keys may be numbers; dataclass fields are named by texts.
    return {str(key): value for key, value in plain.items()}


def register_resolvers() -> None:
    """Register `${first:a,b}` and `${per_cell:count,size}`, or `${per_cell:count,size,least}`."""
    # replace=True: resolvers are global to the process, and a second composing would otherwise fail on the first name.
    OmegaConf.register_new_resolver("first", _first_given, replace=True)
    OmegaConf.register_new_resolver("per_cell", _per_cell, replace=True)


def _first_given(*values: Any) -> Any:
    """The first value that is not null."""
    return next((value for value in values if value is not None), None)


def _per_cell(count: float, size: Any, least: int = 0) -> int:
    """`count` for each cell of a grid of N x N cells, or of [rows, columns]; `least` in all.

    A fraction gives a whole number of `least`: .2 for each of 100 x 100 cells in thousands are 2000, of 110 x 110 3000.
    """
    sides = (size, size) if isinstance(size, int) else size
    if not isinstance(sides, Sequence) or not all(isinstance(side, int) for side in sides):
        return max(math.ceil(count), least)  # such a size is refused when its own option is checked
    if isinstance(count, int):
        return max(count * math.prod(sides), least)
    # Rounded before it is rounded up: .2 · M / 1000 and M / 5000 have to agree, whatever the last bit.
    return max(math.ceil(round(count * math.prod(sides) / least, 9)), 1) * least
