"""Every option there is, and configs to try them on."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir

from trackmdp.app.composer import register
from trackmdp.config import GROUPS, ROOTS, Option, conf_dir, options
from trackmdp.config.compose import composed_values, config_of

REFUSED = {("evaluate", f"log={name}") for name in ("csv", "tensorboard", "wandb", "mlflow")} | {
    (command, "kernel=tracks") for command in ("evaluate", "solve", "frontier", "verify")
}
REFUSED |= {
    (command, "sensor=false_alarm")
    for command in ("train", "compare", "solve", "frontier", "verify")
}
REFUSED |= {("verify", "sensor=footprint")}
MODES = [name for name, schema in GROUPS["kernel"].items() if schema.hides]
REFUSED |= {("train", f"kernel={name}") for name in MODES}
"""Choices that a command's group offers and its rules refuse."""

COMBINATIONS = [
    (command, f"{group}={name}")
    for command, root in ROOTS.items()
    for group, item in options(root).items()
    if group in GROUPS and not isinstance(item, Option)
    for name in GROUPS[group]
    if name != "given"  # set by `trackmdp.train` alone
    if (command, f"{group}={name}") not in REFUSED
]
"""(command, choice) of every choice that a command takes."""


def files_of(command: str, choice: str) -> list[str]:
    """A value for each option that has none in conf/: the files a user must name."""
    group, _, name = choice.partition("=")
    folder = Path(conf_dir())
    places = [(folder / f"{command}.yaml", ""), (folder / group / f"{name}.yaml", f"{group}.")]
    texts = [
        (file.read_text(encoding="utf-8"), prefix) for file, prefix in places if file.is_file()
    ]
    pattern = re.compile(r"^(\w+): \?\?\?", flags=re.MULTILINE)
    return [f"{prefix}{key}=no.npy" for text, prefix in texts for key in pattern.findall(text)]


def composed(command: str, *overrides: str) -> Any:
    """The checked config of a command; `evaluate` gets a baseline if it has none."""
    register()
    words = list(overrides)
    if command == "evaluate" and not any(word.startswith("baseline=") for word in words):
        words.insert(0, "baseline=qmdp")
    with initialize_config_dir(config_dir=conf_dir(), version_base="1.3"):
        values = composed_values(compose(command, overrides=words), ROOTS[command])
        return config_of(values, ROOTS[command])


def of_command(command: str) -> list[tuple[str, Option]]:
    """Dotted key and option of all a command has, in every choice of every group."""
    return [(key, item) for _, key, item in _walk(ROOTS[command], "", "")]


def _walk(schema: type[Any], choice: str, prefix: str) -> Iterator[tuple[str, str, Option]]:
    for key, item in options(schema).items():
        if isinstance(item, Option):
            yield choice, f"{prefix}{key}", item
        elif key in GROUPS and not prefix:
            for name, member in GROUPS[key].items():
                if name == "given":
                    continue
                place = f"{key}.{name}." if item.several else f"{key}."
                yield from _walk(member, f"{key}={name}", place)
        else:
            yield from _walk(item.schema, choice, f"{prefix}{key}.")


def distinct() -> list[tuple[str, list[str], str, Option]]:
    """(command, words it needs, dotted key, option) of every option; one that several places share comes once."""
    found: dict[tuple[str, Option], tuple[str, list[str], str, Option]] = {}
    for command, root in ROOTS.items():
        for choice, key, item in _walk(root, "", ""):
            if (command, choice) in REFUSED:
                continue
            words = [choice] if choice else []
            words += [word for word in files_of(command, choice) if not word.startswith(f"{key}=")]
            if command == "evaluate" and not choice.startswith("baseline="):
                words.append("baseline=qmdp")
            found.setdefault((key, item), (command, words, key, item))
    return list(found.values())
