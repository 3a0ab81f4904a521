"""Commands from their start to their end, in turns with those of another checkout."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping
from statistics import median

from benchmarks.clock import HERE, Usage, checkout, measured
from benchmarks.words import Row, as_words
from trackmdp.errors import UserError

COMMANDS = {
    "train": "train quiet=true",
    "solve": "solve quiet=true",
    "evaluate": "evaluate baseline=qmdp quiet=true",
    "train threads=0": "train threads=0",
    "train --help": "train --help",
    "report --help": "report --help",
}
"""Name -> a command line; the one with 0 threads is refused."""


def rows(
    words: Mapping[str, str],
    commands: tuple[str, ...] = tuple(COMMANDS),
    beside: str = "",
    repeat: int = 5,
) -> Iterator[Row]:
    """One row for each command: medians of `repeat` turns, and their share of those of the checkout `beside`.

    Raises:
        UserError: a command is unknown, or the checkout has no package.
    """
    if beside:
        checkout(beside)
    for name in commands:
        if name not in COMMANDS:
            raise UserError(f"commands={name}: expected some of {', '.join(COMMANDS)}")
        typed = COMMANDS[name].split()
        if "--help" not in typed:
            typed += as_words(words)
        turns = [[_run(typed, place) for place in (HERE, beside) if place] for _ in range(repeat)]
        yield {"command": name} | _medians(turns)


def _run(typed: list[str], place: str) -> Usage:
    with tempfile.TemporaryDirectory() as folder:
        where = [] if "--help" in typed else [f"hydra.run.dir={folder}/run"]
        return measured(*typed, *where, place=place, fails="threads=0" in typed)


def _medians(turns: list[list[Usage]]) -> Row:
    """The figures here, and their share of the figures beside."""
    found: Row = {}
    for key in ("wall_seconds", "cpu_seconds"):
        here, *beside = (
            median(getattr(usage, key) for usage in each) for each in zip(*turns, strict=True)
        )
        found |= {key: here, f"{key}_share": here / beside[0] if beside else None}
    return found
