"""The text of `--help` in 80 columns.

`--help` fits a screen: examples, the options used most, the choices of each group. `--help all` lists every option,
`algo=ppo --help` those of a choice.
"""

from __future__ import annotations

import json
import re
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import fields
from typing import Any

from omegaconf import MISSING

from trackmdp.config import GROUPS, ROOTS, Option, options
from trackmdp.config.checks import check_choice
from trackmdp.config.compose import command_values, known_options
from trackmdp.config.options import listed, several, typed_choices
from trackmdp.config.registry import choice_values, load_plugins, read_values
from trackmdp.config.resume import at_key
from trackmdp.config.sweeping import PLUGINS
from trackmdp.errors import UserError

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
    "compare": [
        "trackmdp compare run=runs/mine run=runs/other baseline=qmdp",
        "trackmdp compare baseline=clocked baseline=qmdp grid.size=5",
    ],
    "solve": ["trackmdp solve", "trackmdp solve solver=lookahead cost.sensor=0.2"],
    "frontier": ["trackmdp frontier accuracy=0.95", "trackmdp frontier sensors=2 cost.safe=0"],
    "verify": ["trackmdp verify", "trackmdp verify grid.size=5"],
    "replay": [
        "trackmdp replay file=episodes.mcap",
        "trackmdp replay file=episodes.mcap episode=0 html=page.html",
    ],
    "report": [
        "trackmdp report sweep=multirun/mine",
        "trackmdp report sweep=multirun/mine watch=true",
    ],
    "export": ["trackmdp export run=runs/mine", "trackmdp export run=runs/mine format=onnx"],
}
"""Command -> lines that can be typed as they stand, once the named files exist."""

_USED = {
    "train": "grid.size grid.t_max grid.max_steps grid.window task.memory cost.sensor cost.safe "
    "seed device threads resume init_from evaluation.every optimal.enabled",
    "evaluate": "run episodes grid.size grid.t_max grid.window task.memory cost.sensor cost.safe "
    "seed",
    "compare": "runs baselines grid.size grid.t_max cost.sensor cost.safe",
    "solve": "grid.size grid.t_max grid.window task.memory cost.sensor cost.safe partition.block "
    "partition.workers verify",
    "frontier": "grid.size grid.t_max cost.sensor cost.safe accuracy sensors resolution",
    "verify": "grid.size grid.t_max cost.sensor cost.safe tolerance",
    "replay": "file episode verify recover html csv layout speed",
    "report": "sweep watch paper threshold every",
    "export": "run format checkpoint",
}
USED = {command: words.split() for command, words in _USED.items()}
"""Command -> the options of `--help`, in reading order."""

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
        command: a name of `trackmdp.app.cli.COMMANDS`.
        words: the other words of the line. ``all`` asks for every option; with a choice such as ``algo=ppo`` only its
            options are shown.

    Raises:
        UserError: a choice is unknown, or a word is neither ``all`` nor like ``algo=ppo``.
    """
    for word in words:
        if word != "all" and "=" not in word:
            raise UserError(f"--help {word}: expected all, group=choice or option=value")
    # Installed packages add choices, which are listed like our own.
    load_plugins()
    typed = _choices(command, words)
    blocks = [
        f"usage: trackmdp {command} [option=value ...] [group=choice ...]",
        *_wrapped(_about(ROOTS[command])),
        "",
    ]
    if typed:
        chosen = " ".join(f"{group}={name}" for group, name in typed.items())
        # Launchers and sweepers are read by multirun alone.
        chosen = f"-m {chosen}" if any(group.startswith("hydra/") for group in typed) else chosen
        blocks += ["Examples", f"  trackmdp {command} {chosen}"]
        for group, names in typed.items():
            for name in _names(names):
                blocks += [*_example(command, chosen, group, name), *_choice(group, name)]
        return "\n".join([*blocks, "", f"trackmdp {command} --help all lists every option.", ""])
    blocks += ["Examples", *(f"  {line}" for line in EXAMPLES[command]), ""]
    for flag, text in _FLAGS.items():
        blocks += _described(flag, text)
    # Not composed, which needs a choice for every group.
    values = command_values(command, {})
    more = _all(command, values) if "all" in words else _most_used(command, values)
    return "\n".join([*blocks, *more, ""])


def _most_used(command: str, values: dict[str, Any]) -> Iterator[str]:
    """The options of `USED`, then one line for the choices of each group."""
    yield from ("", "Options used most")
    known = known_options(values, ROOTS[command])
    for key in USED[command]:
        yield from _described(f"{key}={_shown(key, at_key(values, key))}", known[key].help)
    every = f"trackmdp {command} --help all lists every option with its range and unit"
    groups = [key for key in values if key in GROUPS]
    if not groups:
        yield from ("", f"{every}.")
        return
    yield from ("", "Choices")
    for key in groups:
        yield from _wrapped(f"  {_offered(key, values)}")
    yield from (
        "",
        f"{every},",
        *_wrapped(f"trackmdp {command} kernel=random_walk --help those of a choice."),
    )


def _offered(group: str, values: dict[str, Any]) -> str:
    """The choices of a group, and the one that the command makes by default."""
    default = "none chosen"
    if (node := values[group]) is not None:
        default = node["name"] if "name" in node else listed(node)
    return f"{group}={'|'.join(typed_choices(group))} (default: {default})"


def _all(command: str, values: dict[str, Any]) -> Iterator[str]:
    """Every option of the command, those of every choice of its groups among them."""
    yield from ("", "Options")
    schema = options(ROOTS[command])
    # those of the command itself before its groups
    for key, item in sorted(schema.items(), key=lambda each: not isinstance(each[1], Option)):
        if isinstance(item, Option):
            yield from _entry(key, item, values.get(key))
        elif key in GROUPS:
            any_number = "; any of them as a list, none by []" if item.several else ""
            yield from ("", *_wrapped(f"{_offered(key, values)}{any_number}"))
            for name in GROUPS[key]:
                yield from _choice(key, name)
        else:
            yield from ("", *_wrapped(f"{key}: {_about(item.schema)}"))
            yield from _entries(item.schema, values.get(key), f"{key}.")
    if any("override hydra/sweeper" in each for each in read_values(command)["defaults"]):
        for group in (f"hydra/{part}" for part in PLUGINS):
            default = next(iter(GROUPS[group]))
            shown = f"With -m: {group}={'|'.join(GROUPS[group])} (default: {default})"
            yield from ("", *_wrapped(shown))
            for name in GROUPS[group]:
                yield from _choice(group, name)


def _choices(command: str, words: Sequence[str]) -> dict[str, str]:
    """Group -> the choice that the words make, as it was typed."""
    groups = [
        *(key for key in options(ROOTS[command]) if key in GROUPS),
        *(f"hydra/{group}" for group in PLUGINS),
    ]
    made: dict[str, str] = {}
    for word in words:
        key, _, name = word.partition("=")
        if key not in groups:
            continue
        for each in _names(name) if several(ROOTS[command], key) else [name]:
            check_choice(key, each)
        made[key] = name
    return made


def _names(typed: str) -> list[str]:
    """The choices that one word makes: ``[csv,mcap]``, or a single ``mcap``."""
    return [name for name in typed.strip("[]").split(",") if name]


def _prefix(group: str, name: str) -> str:
    """The beginning of the options of a choice: ``algo.``, or ``log.mcap.`` of one of several."""
    many = any(several(root, group) for root in ROOTS.values())
    return f"{group.replace('/', '.')}." + (f"{name}." if many else "")


def _choice(group: str, name: str) -> Iterator[str]:
    """One choice of a group with its options."""
    schema = GROUPS[group][name]
    yield from ("", *_wrapped(f"  {group}={name}: {_about(schema)}"))
    yield from _entries(schema, choice_values(group, name), _prefix(group, name))


def _example(command: str, chosen: str, group: str, name: str) -> Iterator[str]:
    """A line that sets the first option of a choice."""
    for key, value in choice_values(group, name).items():
        shown = "FILE" if value == MISSING else json.dumps(value).strip('"')
        # An interpolation is not something to type after a `=`: the shell would take the `$`, as it would brackets.
        if key in options(GROUPS[group][name]) and not re.search(r"[$\[{]", shown):
            yield f"  trackmdp {command} {chosen} {_prefix(group, name)}{key}={shown}"
            return


def _entries(schema: type[Any], values: Any, prefix: str) -> Iterator[str]:
    heads = {each.name: each.metadata.get("nested") for each in fields(schema)}
    for key, item in options(schema).items():
        value = (values or {}).get(key)
        if isinstance(item, Option):
            yield from _entry(f"{prefix}{key}", item, value)
        else:
            if heads[key]:
                yield from _wrapped(f"  {prefix}{key}: {heads[key]}")
            yield from _entries(item.schema, value, f"{prefix}{key}.")


def _entry(key: str, described: Option, value: Any) -> list[str]:
    return _described(f"{key}={_shown(key, value)}", f"{described.help}; {described.expected}")


def _shown(key: str, value: Any) -> str:
    """The default as it is typed; an interpolation in angle brackets."""
    shown = "" if value == MISSING else json.dumps(value, ensure_ascii=False).strip('"')
    shown = shown.replace("${.", f"${{{key.rpartition('.')[0]}.")
    # `${per_cell:1.0,${grid.size},10000}` is shown as <1 a cell, at least 10000>, `${algo.envs}` as <algo.envs>
    shown = re.sub(
        r"\$\{per_cell:([0-9]+)(?:\.0)?([0-9.]*),\$\{grid\.size\}", r"${\1\2 a cell", shown
    )
    return re.sub(
        r"\$\{([^{}]*)\}", lambda found: f"<{found[1].replace(',', ', at least ')}>", shown
    )


def _described(head: str, text: str) -> list[str]:
    """A term and its meaning, in two columns; a long term has a line of its own."""
    indent = " " * _COLUMN
    lines = textwrap.wrap(
        text, _WIDTH - 1, initial_indent=indent, subsequent_indent=indent, break_on_hyphens=False
    )
    if len(head) + 2 < _COLUMN:
        return [f"  {head}" + lines[0][len(head) + 2 :], *lines[1:]]
    # As typed it is one word; only a list of mappings is longer than a line, and breaks at its blanks.
    heads = textwrap.wrap(
        f"  {head}", _WIDTH - 1, subsequent_indent=" " * 6, break_long_words=False
    )
    return [*heads, *lines]


def _wrapped(text: str) -> list[str]:
    """A paragraph; its further lines are set in, and lists of choices break after `|`."""
    deeper = " " * (len(text) - len(text.lstrip()) + 4)
    wrapped = textwrap.wrap(
        text.replace("|", "| "), _WIDTH - 1, subsequent_indent=deeper, break_on_hyphens=False
    )
    return [line.replace("| ", "|") for line in wrapped]


def _about(schema: type[Any]) -> str:
    return " ".join((schema.__doc__ or "").split())
