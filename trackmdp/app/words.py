"""Words of a command line as Hydra reads them: `algo.epochs=3`, `seed=0,1`, `~key`; and which of them is wrong."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Glob, Override
from hydra.errors import HydraException
from omegaconf import DictConfig

from trackmdp.config import GROUPS, ROOTS, CommandConfig, Option, options
from trackmdp.config.checks import check_choice, check_option
from trackmdp.config.compose import composed_values, known_options
from trackmdp.config.options import refuse, several
from trackmdp.errors import UserError

MOST = 100_000
"""Runs of a sweep, and values of a word; range(10000000) is a slip."""

Compose = Callable[[Sequence[str]], DictConfig]


def parsed(word: str) -> Override:
    """A word as Hydra reads it.

    Raises:
        UserError: it cannot be read, or names its values by `glob`, which would find the schemas beside the choices.
    """
    try:
        override = OverridesParser.create().parse_override(word)
    except (HydraException, ValueError) as error:  # ValueError: an integer of thousands of digits
        if "=~" in word:  # in quotes it would be a folder of that name
            raise UserError(f"{word}: expected $HOME in place of ~") from error
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


def single_words(override: Override) -> list[str]:
    """The words of the single values of a word.

    Raises:
        UserError: they cannot be counted, or are none or too many.
    """
    key = override.get_key_element()
    if override.is_delete():
        return [str(override.input_line)]
    if not override.is_sweep_override():
        return [f"{key}={override.get_value_element_as_str()}"]
    if not override.is_discrete_sweep():
        raise UserError(
            f"{override.input_line}: expected values that can be counted; hydra/sweeper=optuna searches"
        )
    try:
        found = itertools.islice(override.sweep_string_iterator(), MOST + 1)
        values = [f"{key}={value}" for value in found]
    except ValueError as error:  # range(0,1,0)
        raise UserError(f"{override.input_line}: {error}") from error
    if not 1 <= len(values) <= MOST:  # range(3,0) has none
        raise UserError(f"{override.input_line}: expected 1 to {MOST:,} values")
    return values


def run_words(words: Iterable[str]) -> list[str]:
    """The overrides of the command's own config, without those of Hydra (`hydra.x=...`, `hydra/x=...`)."""
    return [word for word in words if not word.lstrip("+~").startswith(("hydra.", "hydra/"))]


def refuse_deleted(command: str, words: Sequence[str], compose: Compose) -> None:
    """Refuse `~option` and `~optimal`, which Hydra takes: the typed config needs every option.

    Raises:
        UserError: there is such a word.
    """
    deleted = [word for word in run_words(words) if word.startswith("~")]
    overrides = [each for each in map(parsed, deleted) if each.key_or_group not in GROUPS]
    if overrides:
        root = ROOTS[command]
        kept = [word for word in words if word not in deleted]
        known = known_options(composed_values(compose(kept), root), root)
        for override in overrides:
            _check_value(override, known)


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
    if isinstance(error, RecursionError):
        typed = " ".join(words)[:200]
        return UserError(f"{typed}: nested too deep, or a file that its own defaults name")
    # No word is at fault: an interpolation, a defaults list or a user's file; Hydra's message is all there is.
    return error if isinstance(error, UserError) else UserError(_plain(error))


def _refuse_wrong(error: Exception, command: str, words: Sequence[str], compose: Compose) -> None:
    """Refuse the first of the words that is wrong.

    Raises:
        UserError: there is one.
    """
    root, overrides = ROOTS[command], [parsed(word) for word in words]
    for override in overrides:
        _check_form(override, command, str(error))
    # An experiment, a launcher or a sweeper is chosen as well, by the name of a file.
    groups = GROUPS.keys() & options(root) | ({"experiment"} if command == "train" else set())
    keys = {each.key_or_group for each in overrides}
    groups |= {key for key in keys if key.startswith("hydra/")}
    chosen = [override for override in overrides if override.key_or_group in groups]
    # Choices before values: with algo=pppo every algo.* would be unknown, though only the choice is wrong.
    for override in chosen:
        _check_choice(override, root)
    # The options depend on the choices: in algo=a2c,ppo algo.epochs is an option of one of them. The first
    # combination that composes and shows a mistake decides.
    for choices in itertools.product(*map(single_words, chosen)):
        try:
            known = known_options(composed_values(compose(choices), root), root)
        except (
            Exception
        ):  # the choices themselves are at fault; at the end Hydra's own message is reported
            continue
        for override in overrides:
            if override not in chosen:
                _check_value(override, known)


def _check_form(override: Override, command: str, message: str) -> None:
    """Refuse several values for one run, by Hydra's message, an addition of what is there, or another's group."""
    word, key, value = override.input_line, override.key_or_group, override.value()
    single_words(override)  # refused here where they cannot be listed
    # Hydra's message is that a sweep "requires --multirun"; nothing is wrong with the value itself.
    if override.is_sweep_override() and "multirun" in message.lower():
        _, _, names = str(word).partition("=")
        if several(ROOTS[command], key) and "[" not in names:
            raise UserError(f"{word}: expected {key}=[{names}]")
        raise UserError(f"{word}: expected one value; add -m to run once for each")
    if override.is_add() and isinstance(value, str) and "Multiple values" in message:
        raise UserError(f"{word}: in the config already, expected {key}={value}")
    group = key.partition(".")[0]
    # Those of Hydra all commands have.
    if group in GROUPS.keys() - options(ROOTS[command]) and not group.startswith("hydra/"):
        raise UserError(f"{word}: {command} has no {group}")


def _check_choice(override: Override, root: type[CommandConfig]) -> None:
    """Refuse a choice that does not exist, or a list where one is expected."""
    group = override.key_or_group
    files = GlobalHydra.instance().config_loader().get_group_options(group)
    for value in values_of(override):
        if isinstance(value, list) and not several(root, group):
            raise UserError(f"{override.input_line}: expected one choice, not a list")
        for name in value if isinstance(value, list) else [value]:
            if name in files:
                continue
            if group in options(root):
                check_choice(group, name)
            # Schemas are stored as `base_...`, and are no choices.
            known = [each for each in files if not each.startswith("base_")]
            raise refuse(group, name, f"one of {', '.join(known) or 'none, since there is none'}")


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


def _plain(error: Exception) -> str:
    """The messages of an error and its cause in one line, without repetitions and hints on Hydra's syntax."""
    # Hydra wraps OmegaConf's error, and each names a part: the place, and the mistake.
    messages = [str(each).strip() for each in (error, error.__cause__) if each is not None]
    lines = [line.strip(" .:") for text in messages for line in text.splitlines()[:2]]
    kept = [line for line in lines if line and not line.startswith(("To append", "full_key"))]
    return ": ".join(dict.fromkeys(kept)) or type(error).__name__
