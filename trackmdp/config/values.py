"""The values of `conf/` as they stand there: of a command, of a choice, of a choice within another's options."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from trackmdp.config.checks import unknown_option, validate
from trackmdp.config.options import GROUPS, Option, options
from trackmdp.config.registry import conf_file
from trackmdp.errors import UserError


def nested_choice(group: str, name: str, given: dict[str, Any], key: str, root: Any) -> Any:
    """A choice that stands among the options of another one, checked; what is not given is as in `conf/`.

    Args:
        group: of the choice.
        name: of the choice.
        given: some of its options.
        key: where it stands, for messages.
        root: the config of the command.

    Raises:
        UserError: an option is unknown or missing, or a value is not allowed.
    """
    values, known = choice_values(group, name, {}), options(GROUPS[group][name])
    for option in given:
        if option not in known:
            beside = {f"{key}.{each}": item for each, item in known.items() if isinstance(item, Option)}
            raise unknown_option(f"{key}.{option}", beside)
    plain = resolved(values | given, known, f"{key}.")
    node = GROUPS[group][name](**{option: plain[option] for option in known})
    validate(node, key, root)
    return node


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
    plain = OmegaConf.to_container(OmegaConf.load(file))
    # YAML keys may be numbers; dataclass fields are named by texts.
    assert isinstance(plain, dict), file
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
