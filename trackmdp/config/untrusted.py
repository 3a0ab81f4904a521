"""Reading YAML that somebody else wrote: bounded in size, depth and what its aliases unfold to, and plain data only."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import yaml  # type: ignore[import-untyped]  # a dependency of OmegaConf
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from trackmdp.errors import UserError
from trackmdp.untrusted import reason

MAX_BYTES = 2**20
"""Bytes of the largest config file that is read."""

_MAX_NODES, _MAX_DEPTH = 100_000, 50
_CODE = ("_target_", "()")
"""Keys by which Hydra and Python's logging name what is called."""


def parse_yaml(text: str | bytes, source: str) -> DictConfig:
    """The mapping in YAML text, in UTF-8 where it is bytes; `source` is what messages call it.

    Raises:
        UserError: it is not YAML of a mapping, unfolds to too much, or names code to call.
    """
    try:
        text = text.decode() if isinstance(text, bytes) else text
        _check_size(text)
        if not isinstance(yaml.safe_load(text), (dict, type(None))):
            raise ValueError("expected a mapping")
        config: Any = OmegaConf.create(text)
        # Not resolved: `${oc.env:NAME}` would copy a variable of the reader's environment into the config.
        plain = OmegaConf.to_container(config, resolve=False)
        # `!!binary aGk=`, which has no form in JSON, and so in no digest, label or summary.
        if any(isinstance(each, bytes) for _, key, value in entries(plain) for each in (key, value)):
            raise ValueError("bytes, expected text and numbers")
    except (yaml.YAMLError, OmegaConfBaseException, ValueError, RecursionError, AttributeError, TypeError) as error:
        raise UserError(f"{source}: not a config ({reason(error)})") from error
    if key := names_code(plain):
        raise UserError(f"{source}: {key}: a config is data, and names no code to call")
    return config


def names_code(plain: Any) -> str:
    """The dotted key of the first entry that names what is called; `""` where none does."""
    # `_target_: os.system` is what hydra.utils.instantiate calls, `(): ...` what logging.config.dictConfig calls.
    return next((place for place, key, _ in entries(plain) if key in _CODE), "")


def entries(plain: Any, prefix: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Dotted place, key and value of every entry of a plain config, the outer ones before those within them."""
    within = plain.items() if isinstance(plain, dict) else enumerate(plain) if isinstance(plain, list) else ()
    for key, value in within:
        yield f"{prefix}{key}", key, value
        yield from entries(value, f"{prefix}{key}.")


def _check_size(text: str) -> None:
    """Count what the text unfolds to, from its events alone, before anything is built.

    An alias counts as all that its anchor holds: nine lists of nine aliases each, ten times over, are 9^10 nodes in 700
    bytes.

    Raises:
        ValueError: too many nodes, too deep, or an alias within its own anchor.
    """
    sizes: dict[str, int] = {}  # of the anchors that are complete
    opened: list[tuple[str | None, int]] = []  # anchor of each open collection, and the count when it began
    count = 0
    for event in yaml.parse(text, Loader=yaml.SafeLoader):
        if isinstance(event, yaml.AliasEvent):
            # An anchor is in `sizes` once its collection is closed: an alias within it would unfold for ever.
            if event.anchor not in sizes:
                raise ValueError(f"alias *{event.anchor} stands inside its own anchor, or before it")
            # Example: `a: &x [1, 2]` closes with sizes[x] = 3 (the list and its two items); `b: [*x, *x]` then counts
            # 1 + 3 + 3.
            count += sizes[event.anchor]
        elif isinstance(event, yaml.CollectionStartEvent):
            opened.append((event.anchor, count))
            count += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, began = opened.pop()
            if anchor is not None:
                sizes[anchor] = count - began
        elif isinstance(event, yaml.ScalarEvent):
            count += 1
            if event.anchor is not None:
                sizes[event.anchor] = 1
        if count > _MAX_NODES or len(opened) > _MAX_DEPTH:
            raise ValueError(f"more than {_MAX_NODES:,} values, or deeper than {_MAX_DEPTH} levels")
