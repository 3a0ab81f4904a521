"""Words of a command line as Hydra reads them: `algo.epochs=3`, `seed=0,1`, `~key`; and which of them is wrong."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Glob, Override
from hydra.errors import HydraException
from omegaconf import DictConfig

from trackmdp.config import GROUPS, ROOTS, Option, options
from trackmdp.config.checks import check_choice, check_option
from trackmdp.config.compose import composed_values, known_options
from trackmdp.config.options import listed, refuse, several
from trackmdp.errors import UserError

Compose = Callable[[Sequence[str]], DictConfig]


def parsed(word: str) -> Override:
    """A word as Hydra reads it.

    Raises:
        UserError: it cannot be read, or names its values by `glob`, which would find the schemas beside the choices.
    """
    try:
        override = OverridesParser.create().parse_override(word)
    except (HydraException, ValueError) as error:  # ValueError: an integer of thousands of digits
        raise UserError(
            f"{word}: expected option=value (a value with commas or letters beyond a to z needs quotes: \"'...'\")"
        ) from error
    if isinstance(override.value(), Glob):
        raise UserError(f"{word}: expected the values themselves, separated by commas")
    return override


def gathered(words: Sequence[str]) -> list[str]:
    """The words of `compare`, with runs and baselines put together: run=a run=b becomes runs=[a,b]."""
    kept = list(words)
    for name in ("run", "baseline"):
        values = [word.partition("=")[2] for word in words if word.startswith(f"{name}=")]
        if values:
            kept = [word for word in kept if not word.startswith(f"{name}=")]
            kept.append(f"{name}s=[{','.join(values)}]")
    return kept


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


def diagnose(error: Exception, command: str, words: Sequence[str], compose: Compose) -> UserError:
    """The `UserError` that names the one of the typed `words` that Hydra's `error` is about.

    Args:
        error: of composing.
        command: the command.
        words: its overrides, as typed.
        compose: composes a config from overrides.
    """
    try:
        # Composing stops at the first mistake in its own order, and its message names Hydra's internals. The words are
        # gone through again here, to name the wrong one and the expectation.
        if not isinstance(error, UserError):  # else a file of the user's was refused
            _refuse_wrong(error, command, words, compose)
    except UserError as refusal:
        return refusal
    # No word is at fault: an interpolation, a defaults list or a user's file; Hydra's message is all there is.
    return error if isinstance(error, UserError) else UserError(_plain(error))


def _refuse_wrong(error: Exception, command: str, words: Sequence[str], compose: Compose) -> None:
    """Refuse the first of the words that is wrong.

    Raises:
        UserError: there is one.
    """
    overrides = [parsed(word) for word in words]
    for override in overrides:
        values_of(override)  # refused here where they cannot be listed
    # Hydra's message is that a sweep "requires --multirun"; nothing is wrong with the value itself.
    sweeps = [override.input_line for override in overrides if override.is_sweep_override()]
    if sweeps and ("multirun" in str(error).lower()):
        group, _, names = str(sweeps[0]).partition("=")
        if several(ROOTS[command], group) and "[" not in names:
            raise UserError(f"{sweeps[0]}: expected {group}=[{names}]")
        raise UserError(f"{sweeps[0]}: expected one value; add -m to run once for each")
    for override in overrides:
        key, value = override.key_or_group, override.value()
        if override.is_add() and isinstance(value, str) and "Multiple values" in str(error):
            raise UserError(f"{override.input_line}: in the config already, expected {key}={value}")
    _check_groups(overrides, command)
    # An experiment, a launcher or a sweeper: exactly one, by the name of a file.
    named = ("hydra/", "experiment") if command == "train" else "hydra/"
    files = [override for override in overrides if override.key_or_group.startswith(named)]
    of_command = GROUPS.keys() & options(ROOTS[command])
    groups = [override for override in overrides if override.key_or_group in of_command]
    # Choices before values: with algo=pppo every algo.* would be unknown, though only the choice is wrong.
    for override in files:
        _check_file(override, str(error))
    for override in groups:
        _check_choice(override, command, str(error))
    # The options depend on the choices: in algo=a2c,ppo algo.epochs is an option of one of them. The first
    # combination that composes and shows a mistake decides.
    for choices in itertools.product(*map(_single_words, [*files, *groups])):
        try:
            values = composed_values(compose(choices), ROOTS[command])
            known = known_options(values, ROOTS[command])
        except (
            Exception
        ):  # the choices themselves are at fault; at the end Hydra's own message is reported
            continue
        for override in overrides:
            if override not in [*files, *groups]:
                _check_value(override, known)


def _check_groups(overrides: Sequence[Override], command: str) -> None:
    """Refuse a word of a group that the command does not have, before the choice that it belongs to is asked for."""
    of_others = GROUPS.keys() - options(ROOTS[command])
    for override in overrides:
        group = override.key_or_group.partition(".")[0]
        if group in of_others and not group.startswith("hydra/"):  # which all commands have
            raise UserError(f"{override.input_line}: {command} has no {group}")


def _check_choice(override: Override, command: str, message: str) -> None:
    """Refuse a list where one choice is expected, or a choice that Hydra did not find, by its message `message`."""
    group = override.key_or_group
    if isinstance(override.value(), list) and not several(ROOTS[command], group):
        raise UserError(f"{override.input_line}: expected one choice, not a list")
    for value in _names(override):
        # Hydra has `find` for a single choice and `load` of one in a list.
        missing = any(f"Could not {verb} '{group}/{value}" in message for verb in ("find", "load"))
        if missing or not isinstance(value, str):
            check_choice(group, value)


def _check_file(override: Override, message: str) -> None:
    """Refuse a choice that does not exist, by its message `message`, or several where one is expected."""
    key, values = override.key_or_group, values_of(override)
    if len(values) > 1:
        raise UserError(f"{override.input_line}: expected one {key.split('/')[-1]}")
    if f"Could not find '{key}/{values[0]}'" in message:
        # Hydra ends its message with one option a line, each after a tab. Schemas are stored as `base_...`, and are no
        # choices.
        tail = message.partition(f"Available options in '{key}':")[2].splitlines()[1:]
        names = [
            line.strip() for line in itertools.takewhile(lambda line: line.startswith("\t"), tail)
        ]
        known = [name for name in names if not name.startswith("base_")]
        raise refuse(key, values[0], f"one of {', '.join(known) or 'none, since there is none'}")


def _check_value(override: Override, known: dict[str, Option]) -> None:
    """Refuse an option that is not among the known ones, or has a value that is not allowed."""
    key = override.key_or_group
    # Hydra's own options have no schema of ours; `group@package` moves a choice to a place that is not known here.
    if key.split(".")[0] == "hydra" or "@" in key:
        return
    if inner := [name for name in known if name.startswith(f"{key}.")]:
        raise UserError(
            f"{override.input_line}: expected {inner[0]}=value (known: {', '.join(inner)})"
        )
    # Every option exists already: `+` would add a second meaning, `~` would leave a hole in the typed config.
    if key in known and (override.is_delete() or override.is_add()):
        raise UserError(f"{override.input_line}: expected {key}=value, without + or ~")
    for value in values_of(override):
        check_option(key, value, known)


def _single_words(override: Override) -> list[str]:
    """A word for each of the choices that a word makes."""
    values = [listed(value) if isinstance(value, list) else value for value in values_of(override)]
    return [f"{override.key_or_group}={value}" for value in values]


def _names(override: Override) -> list[Any]:
    """The choices that a word makes; a list of a group of several is taken apart."""
    return [
        name
        for value in values_of(override)
        for name in (value if isinstance(value, list) else [value])
    ]


def _plain(error: Exception) -> str:
    """The messages of an error and its cause in one line, without repetitions and hints on Hydra's syntax."""
    # Hydra wraps OmegaConf's error, and each names a part: the place, and the mistake.
    messages = [str(each).strip() for each in (error, error.__cause__) if each is not None]
    lines = [line.strip(" .:") for text in messages for line in text.splitlines()[:2]]
    kept = [line for line in lines if line and not line.startswith(("To append", "full_key"))]
    return ": ".join(dict.fromkeys(kept)) or type(error).__name__
