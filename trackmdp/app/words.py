"""Words of a command line as Hydra reads them: `algo.epochs=3`, `seed=0,1`, `+log.csv.every=2`, `~key`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Glob, Override
from hydra.errors import HydraException

from trackmdp.errors import UserError


def parsed(word: str) -> Override:
    """A word as Hydra reads it.

    Raises:
        UserError: it cannot be read, or names its values by `glob`, which would find the schemas beside the choices.
    """
    try:
        override = OverridesParser.create().parse_override(word)
    except (HydraException, ValueError) as error:  # ValueError: an integer of thousands of digits
        raise UserError(f"{word}: expected option=value (a value with blanks or commas needs quotes)") from error
    if isinstance(override.value(), Glob):
        raise UserError(f"{word}: expected the values themselves, separated by commas")
    return override


def values_of(override: Override) -> list[Any]:
    """The value of a word, or those of a sweep.

    Raises:
        UserError: they cannot be listed, as those of range(0,1,0).
    """
    if not override.is_discrete_sweep():
        return [override.value()]
    try:
        return list(override.sweep_iterator())
    except ValueError as error:
        raise UserError(f"{override.input_line}: {error}") from error


def run_words(words: Iterable[str]) -> list[str]:
    """The overrides of the command's own config, without those of Hydra (`hydra.x=...`, `hydra/x=...`)."""
    return [word for word in words if not word.lstrip("+~").startswith(("hydra.", "hydra/"))]
