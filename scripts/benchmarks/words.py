"""The command line of the benchmarks: words to options, rows to a table that names the machine."""

from __future__ import annotations

import importlib
import inspect
import json
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import trackmdp as tm
from trackmdp.app.words import parsed
from trackmdp.config.compose import compose
from trackmdp.errors import UserError, output_of
from trackmdp.training.devices import machine
from trackmdp.world.configured import build_world

Row = dict[str, Any]
PARTS = (
    "start",
    "sweep",
    "env",
    "collector",
    "train",
    "size",
    "handoff",
    "memory",
    "peers",
    "log",
    "regret",
    "matrix",
    "bracket",
    "workers",
    "values",
)
WORLD = ("grid.", "kernel", "cost.", "targets.")
_SHARED: Row = {"threads": 1, "out": ""}


def main(words: Sequence[str]) -> int:
    """Run one part and print its table; returns the exit status, 2 after a mistake in the words."""
    try:
        given = parse(words)
        if "part" not in given:
            raise UserError(f"part: missing, expected one of {', '.join(PARTS)}")
        sys.stdout.write(table(given["part"], measure(given)) + "\n")
    except UserError as error:
        sys.stderr.write(f"benchmark: {error}\n")
        return 2
    return 0


def parse(words: Sequence[str]) -> dict[str, str]:
    """Key -> text of words `key=value`.

    Raises:
        UserError: a word has another form.
    """
    for word in words:
        if not word.partition("=")[2]:
            raise UserError(f"{word}: expected key=value")
    return {key: value for key, _, value in (word.partition("=") for word in words)}


def measure(given: Mapping[str, str]) -> list[Row]:
    """The rows of `given["part"]`.

    Raises:
        UserError: the part or a key is unknown, or a value has another type than the default.
    """
    part = given["part"]
    if part not in PARTS:
        raise UserError(f"part={part}: expected one of {', '.join(PARTS)}")
    rows: Callable[..., Iterable[Row]] = importlib.import_module(f"benchmarks.{part}").rows
    world = {key: text for key, text in given.items() if key.startswith(WORLD)}
    own = {key: text for key, text in given.items() if key not in (*world, "part")}
    known = _SHARED | defaults(rows)
    for key in own:
        if key not in known:
            raise UserError(f"{key}: unknown with part={part}, expected one of {', '.join(known)}")
    options = known | {key: value_of(key, text, known[key]) for key, text in own.items()}
    _set_threads(options["threads"])
    out = options["out"] and output_of(options["out"], "out")
    found: list[Row] = []
    for row in rows(world, **{key: options[key] for key in defaults(rows)}):
        found.append(row)
        if out:
            # After every row: an interrupted benchmark keeps the rows measured so far.
            content = {"part": part, "machine": machine(), "rows": found}
            out.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    return found


def defaults(rows: Callable[..., Iterable[Row]]) -> Row:
    """The options of a part: the keyword arguments of its `rows`, with their defaults."""
    parameters = inspect.signature(rows).parameters.values()
    return {each.name: each.default for each in parameters if each.default is not each.empty}


def value_of(key: str, text: str, default: Any) -> Any:
    """The value of `text`, of the type of `default`; a tuple is typed as `[a,b]` and has elements of one type.

    Raises:
        UserError: the text is no such value.
    """
    if isinstance(default, tuple):
        kind = default[0] if default else ""
        parts = text.removeprefix("[").removesuffix("]").split(",")
        return tuple(value_of(key, part, kind) for part in parts)
    try:
        return type(default)(text)
    except ValueError:
        raise UserError(f"{key}={text}: expected {type(default).__name__}") from None


def world_of(words: Mapping[str, str]) -> Any:
    """The world, or group of targets, of words such as `grid.size=20` and `kernel=drift`.

    Raises:
        UserError: a word is unknown to `trackmdp solve`, or has a value out of range.
    """
    given = {key: parsed(f"{key}={text}").value() for key, text in words.items()}
    cfg = compose("solve", given)
    world = build_world(cfg)
    return world if cfg.targets.count == 1 else tm.Group([world] * cfg.targets.count)


def as_words(words: Mapping[str, str]) -> list[str]:
    """The same words for a command in a process of its own."""
    return [f"{key}={text}" for key, text in words.items()]


def table(part: str, rows: Sequence[Row]) -> str:
    """The rows under their keys, below a line that names the machine; values that are dicts are left out."""
    here = machine()
    threads = here["torch_threads"]
    title = f"{part}: {here['processor']}, {here['cores']} cores, {threads} torch threads"
    if not rows:
        return f"{title}\nno rows"
    keys = [key for key, value in rows[0].items() if not isinstance(value, dict)]
    cells = [keys, *([_text(row[key]) for key in keys] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines = (
        "  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True))
        for row in cells
    )
    return "\n".join([title, *lines])


def _set_threads(threads: int) -> None:
    import torch

    if threads < 1:
        raise UserError(f"threads={threads}: expected 1 or more")
    torch.set_num_threads(threads)


def _text(value: Any) -> str:
    if value is None:
        return "–"
    if isinstance(value, float):
        return f"{value:,.3g}" if abs(value) < 1000 else f"{value:,.0f}"
    return str(value)
