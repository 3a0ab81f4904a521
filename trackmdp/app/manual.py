"""The text of `--help`: every group and option of a command with unit, range, default and choices."""

from __future__ import annotations

import inspect
import json
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from trackmdp.config import GROUPS, ROOTS, SELECTORS, Option, conf_dir, options

__all__ = ["manual"]

USAGE = """\
usage: trackmdp {command} [option=value ...] [group=choice ...]      (or: python scripts/{command}.py ...)

{about}

  -m, --multirun              run once for every combination of option=a,b,c, in one process after the other
  -c job, --cfg job           show the resolved options instead of running
  --config-dir FOLDER         a folder of your own with further choices, such as FOLDER/kernel/mine.yaml
  --info, --hydra-help        about Hydra, which reads the options
  hydra.run.dir=FOLDER        where the results go
"""


def manual(command: str) -> str:
    """The help of one command; the values shown are those of `conf/`."""
    folder = Path(conf_dir())
    values = _read(folder / f"{command}.yaml")
    chosen = _chosen(values)
    schema = ROOTS[command]
    top = {key: item for key, item in options(schema).items() if isinstance(item, Option)}
    lines = [USAGE.format(command=command, about=_about(schema)), "Options"]
    for key, described in top.items():
        lines += _entry(key, described, values.get(key))
    for key, item in options(schema).items():
        if isinstance(item, Option):
            continue
        if key in GROUPS:
            lines += _group(folder, key, chosen.get(key))
            lines += _selectors(key, chosen)
        else:
            lines += ["", f"{key}: {_about(item)}", *_entries(item, values.get(key), f"{key}.")]
    return "\n".join([*lines, ""])


def _group(folder: Path, group: str, default: str | None) -> Iterator[str]:
    yield ""
    yield f"{group}={'|'.join(GROUPS[group])}   (default: {default or 'none chosen'})"
    for name, schema in GROUPS[group].items():
        yield f"  {group}={name}: {_about(schema)}"
        yield from (f"  {line}" for line in _entries(schema, _values(folder, group, name), f"{group}."))


def _selectors(group: str, chosen: dict[str, str | None]) -> Iterator[str]:
    for name, selector in SELECTORS.items():
        if selector.group == group and name in chosen:
            yield from ("", f"{name}={'|'.join(selector.choices)}   (default: {chosen[name]}) {selector.about}")
            yield from (f"  {name}={choice}: {text}" for choice, text in selector.choices.items())


def _entries(schema: type[Any], values: Any, prefix: str) -> Iterator[str]:
    for key, item in options(schema).items():
        value = (values or {}).get(key)
        if isinstance(item, Option):
            yield from _entry(f"{prefix}{key}", item, value)
        else:
            yield from _entries(item, value, f"{prefix}{key}.")


def _entry(key: str, described: Option, value: Any) -> list[str]:
    shown = "" if value == "???" else json.dumps(value, ensure_ascii=False).strip('"')
    text = f"{described.help}; {described.expected}"
    indent = " " * 34
    wrapped = textwrap.wrap(text, 118, initial_indent=indent, subsequent_indent=indent, break_long_words=False)
    head = f"  {key}={shown}"
    if len(head) < len(indent):
        return [head + wrapped[0][len(head) :], *wrapped[1:]]
    return [head, *wrapped]


def _values(folder: Path, group: str, name: str) -> dict[str, Any]:
    """The values of one choice; a file that only points to another group's is followed."""
    values = _read(folder / group / f"{name}.yaml")
    for entry in values.get("defaults", []):
        if isinstance(entry, dict):
            (target, choice), *_ = entry.items()
            for selector, item in SELECTORS.items():
                choice = choice.replace(f"${{{selector}}}", next(iter(item.choices)))
            values |= _values(folder, target.strip("/").split("@")[0], choice)
    return values


def _chosen(values: dict[str, Any]) -> dict[str, str | None]:
    """Group -> the choice made in a `defaults` list."""
    return {group: name for entry in values["defaults"] if isinstance(entry, dict) for group, name in entry.items()}


def _read(file: Path) -> dict[str, Any]:
    plain = OmegaConf.to_container(OmegaConf.load(file))
    assert isinstance(plain, dict)
    return {str(key): value for key, value in plain.items()}


def _about(schema: type[Any]) -> str:
    return " ".join(inspect.cleandoc(schema.__doc__ or "").split())
