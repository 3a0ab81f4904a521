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

import importlib
import importlib.metadata
import os
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

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
        found: Any = importlib.import_module(module)
        # The attribute may be a method: `trackmdp.policies.policy:Policy.random_k`.
        for name in attribute.split("."):
            found = getattr(found, name)
    except (ImportError, AttributeError) as error:
        # A missing third-party module inside ours is a bug or a missing extra, and keeps its own message.
        raise UserError(f"{node.name}: cannot be made, {node.makes}: {error}") from error
    made: Callable[..., Any] = found
    return made


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
