"""The text of `--help`: examples, then every option of a command, or of what its words choose, in 80 columns."""

from __future__ import annotations

import json
import re
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import fields
from typing import Any

from trackmdp.config import GROUPS, ROOTS, SELECTORS, Option, options
from trackmdp.config.checks import check_choice
from trackmdp.config.options import listed, several
from trackmdp.config.registry import choice_values, load_plugins, read_values
from trackmdp.config.sweeping import PLUGINS

EXAMPLES = {
    "train": [
        "trackmdp train",
        "trackmdp train algo=ppo seed=3 hydra.run.dir=runs/mine",
        "trackmdp train resume=auto hydra.run.dir=runs/mine",
        "trackmdp train kernel=table kernel.path=table.npy grid.size=5",
        "trackmdp train -m algo=hindsight,ppo cost.sensor=0.16,0.2 seed=0,1",
        "trackmdp train algo=ppo --help",
    ],
    "evaluate": ["trackmdp evaluate run=runs/mine", "trackmdp evaluate baseline=qmdp grid.size=5"],
    "solve": ["trackmdp solve", "trackmdp solve solver=lookahead cost.sensor=0.2"],
    "verify": ["trackmdp verify", "trackmdp verify grid.size=5"],
    "benchmark": ["trackmdp benchmark part=env", "trackmdp benchmark part=train threads=2"],
    "replay": ["trackmdp replay file=episodes.mcap", "trackmdp replay file=episodes.mcap episode=0 html=page.html"],
    "report": ["trackmdp report sweep=multirun/mine", "trackmdp report sweep=multirun/mine watch=true"],
    "export": ["trackmdp export run=runs/mine", "trackmdp export run=runs/mine format=onnx"],
}
"""Command -> lines that can be typed as they stand, once there is what they name."""

_FLAGS = {
    "-m, --multirun": "run once for every combination of option=a,b,c, each in a process of its own",
    "-c job, --cfg job": "show the resolved options instead of running",
    "--config-dir FOLDER": "a folder of your own with further choices, such as FOLDER/kernel/mine.yaml",
    "--info, --hydra-help": "about Hydra, which reads the options",
    "hydra.run.dir=FOLDER": "where the results go",
}

_WIDTH, _COLUMN = 80, 30


def manual(command: str, words: Sequence[str] = ()) -> str:
    """The help of one command; the values shown are those of `conf/`.

    Args:
        command: whose help.
        words: what stands before `--help`; where a choice is among them, such as ``algo=ppo``, only what it reads is
            shown.

    Raises:
        UserError: a choice is unknown.
    """
    # Installed packages add choices, which are listed like our own.
    load_plugins()
    typed = _choices(command, words)
    # The YAML files are read as they stand: composing would need a choice for every group, and the help is about all.
    values = read_values(command)
    blocks = [f"usage: trackmdp {command} [option=value ...] [group=choice ...]", *_wrapped(_about(ROOTS[command])), ""]
    if typed:
        chosen = " ".join(f"{group}={name}" for group, name in typed.items())
        # Launchers and sweepers are read by multirun alone.
        chosen = f"-m {chosen}" if any(group.startswith("hydra/") for group in typed) else chosen
        blocks += ["Examples", f"  trackmdp {command} {chosen}"]
        # A selector stands among what its group's choice reads.
        made = [(group, _names(names)) for group, names in typed.items() if group not in SELECTORS]
        for group, name in ((group, name) for group, names in made for name in names):
            blocks += [*_example(command, chosen, group, name), *_choice(group, name, typed)]
            blocks += _read_selectors(group, name, typed)
        return "\n".join([*blocks, "", f"trackmdp {command} --help lists every other option.", ""])
    blocks += ["Examples", *(f"  {line}" for line in EXAMPLES[command]), ""]
    for flag, text in _FLAGS.items():
        blocks += _described(flag, text)
    return "\n".join([*blocks, *_all(command, values), ""])


def _all(command: str, values: dict[str, Any]) -> Iterator[str]:
    """Every option of the command, those of every choice of its groups among them."""
    yield from ("", "Options")
    chosen = {key: name for each in values["defaults"] if isinstance(each, dict) for key, name in each.items()}
    schema = options(ROOTS[command])
    # those of the command itself before its groups
    for key, item in sorted(schema.items(), key=lambda each: not isinstance(each[1], Option)):
        if isinstance(item, Option):
            yield from _entry(key, item, values.get(key))
            continue
        if key not in GROUPS:
            yield from ("", *_wrapped(f"{key}: {_about(item)}"), *_entries(item, values.get(key), f"{key}."))
            continue
        line = f"{key}={'|'.join(GROUPS[key])} (default: {chosen.get(key) or 'none chosen'})"
        if several(ROOTS[command], key):
            line = f"{key}={listed(GROUPS[key])}: any of them, none by {key}=[] (default: {listed(chosen[key])})"
        yield from ("", *_wrapped(line))
        yield from _selectors(key, chosen)
        for name in GROUPS[key]:
            yield from _choice(key, name, {})
    if "override hydra/sweeper" in chosen:
        for group in (f"hydra/{part}" for part in PLUGINS):
            default = next(iter(GROUPS[group]))
            yield from ("", *_wrapped(f"With -m: {group}={'|'.join(GROUPS[group])} (default: {default})"))
            for name in GROUPS[group]:
                yield from _choice(group, name, {})


def _choices(command: str, words: Sequence[str]) -> dict[str, str]:
    """Group -> the choice that the words make, as it was typed, a selector's among them."""
    groups = [*(key for key in options(ROOTS[command]) if key in GROUPS), *(f"hydra/{group}" for group in PLUGINS)]
    made: dict[str, str] = {}
    for word in words:
        key, _, name = word.partition("=")
        if (SELECTORS[key].group if key in SELECTORS else key) not in groups:
            continue
        for each in _names(name) if several(ROOTS[command], key) else [name]:
            check_choice(key, each)
        made[key] = name
    return made if made.keys() - SELECTORS.keys() else {}  # a selector alone chooses nothing


def _names(typed: str) -> list[str]:
    """The choices that one word makes: ``[csv,mcap]``, or a single ``mcap``."""
    return [name for name in typed.strip("[]").split(",") if name]


def _prefix(group: str, name: str) -> str:
    """What stands before the options of a choice: ``algo.``, or ``log.mcap.`` of one of several."""
    many = any(several(root, group) for root in ROOTS.values() if group in options(root))
    return f"{group.replace('/', '.')}." + (f"{name}." if many else "")


def _choice(group: str, name: str, typed: dict[str, str]) -> Iterator[str]:
    """One choice of a group with its options; a selector that was typed says which of the group's it stands for."""
    values = _values(group, name, typed)
    schema = GROUPS[group][values["name"]]
    yield from ("", *_wrapped(f"  {group}={name}: {_about(schema)}"))
    yield from _entries(schema, values, _prefix(group, name))


def _example(command: str, chosen: str, group: str, name: str) -> Iterator[str]:
    """A line that sets the first option of a choice."""
    for key, value in _values(group, name, {}).items():
        if isinstance(options(GROUPS[group][name]).get(key), Option) and not isinstance(value, (dict, list)):
            # "???" is OmegaConf's mark of a value that must be given.
            shown = "FILE" if value == "???" else json.dumps(value).strip('"')
            # An interpolation is not something to type after a `=`: the shell would take the `$`.
            if "$" not in shown:
                yield f"  trackmdp {command} {chosen} {_prefix(group, name)}{key}={shown}"
                return


def _selectors(group: str, chosen: dict[str, Any]) -> Iterator[str]:
    for name, selector in SELECTORS.items():
        if selector.group == group and name in chosen:
            yield from ("", *_wrapped(f"{name}={'|'.join(selector.choices)} ({chosen[name]}) {selector.about}"))
            for choice, text in selector.choices.items():
                yield from _wrapped(f"  {name}={choice}: {text}")


def _read_selectors(group: str, name: str, typed: dict[str, str]) -> Iterator[str]:
    """The selectors that a choice reads, as its file says: ``defaults: [{/credit@_here_: '${credit}/ppo'}]``."""
    # A choice reads a selector where its defaults interpolate it.
    source = str(read_values(f"{group}/{name}").get("defaults"))
    read = {key: typed.get(key, next(iter(item.choices))) for key, item in SELECTORS.items() if f"${{{key}}}" in source}
    yield from _selectors(group, read)


def _entries(schema: type[Any], values: Any, prefix: str) -> Iterator[str]:
    heads = {each.name: each.metadata["nested"] for each in fields(schema) if "nested" in each.metadata}
    for key, item in options(schema).items():
        value = (values or {}).get(key)
        if isinstance(item, Option):
            yield from _entry(f"{prefix}{key}", item, value)
        else:
            if key in heads:
                yield from _wrapped(f"  {prefix}{key}: {heads[key]}")
            yield from _entries(item, value, f"{prefix}{key}.")


def _entry(key: str, described: Option, value: Any) -> list[str]:
    shown = "" if value == "???" else json.dumps(value, ensure_ascii=False).strip('"')
    shown = shown.replace("${.", f"${{{key.rpartition('.')[0]}.")
    # `${per_cell:1.0,${grid.size},10000}` is shown as <1 a cell, at least 10000>, `${algo.envs}` as <algo.envs>
    shown = re.sub(r"\$\{per_cell:([0-9]+)(?:\.0)?([0-9.]*),\$\{grid\.size\}", r"${\1\2 a cell", shown)
    shown = re.sub(r"\$\{([^{}]*)\}", lambda found: f"<{found[1].replace(',', ', at least ')}>", shown)
    return _described(f"{key}={shown}", f"{described.help}; {described.expected}")


def _described(head: str, text: str) -> list[str]:
    """A term and what it is, in two columns; a long term has a line of its own."""
    indent = " " * _COLUMN
    lines = textwrap.wrap(text, _WIDTH - 1, initial_indent=indent, subsequent_indent=indent, break_on_hyphens=False)
    if len(head) + 2 < _COLUMN:
        return [f"  {head}" + lines[0][len(head) + 2 :], *lines[1:]]
    # As typed it is one word; only a list of mappings is longer than a line, and breaks at its blanks.
    heads = textwrap.wrap(f"  {head}", _WIDTH - 1, subsequent_indent=" " * 6, break_long_words=False)
    return [*heads, *lines]


def _wrapped(text: str) -> list[str]:
    """A paragraph; its further lines are set in, and lists of choices break after `|`."""
    deeper = " " * (len(text) - len(text.lstrip()) + 4)
    wrapped = textwrap.wrap(text.replace("|", "| "), _WIDTH - 1, subsequent_indent=deeper, break_on_hyphens=False)
    return [line.replace("| ", "|") for line in wrapped]


def _values(group: str, name: str, typed: dict[str, str]) -> dict[str, Any]:
    """The values of one choice, with the name under which its schema is registered."""
    first = {key: next(iter(selector.choices)) for key, selector in SELECTORS.items()}
    return choice_values(group, name, first | typed)


def _about(schema: type[Any]) -> str:
    return " ".join((schema.__doc__ or "").split())
