"""Turn what Hydra says about a mistyped option into one line: key, value, and what was expected."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from hydra.core.override_parser.types import Override
from omegaconf import DictConfig

from trackmdp.app.words import parsed, values_of
from trackmdp.config import GROUPS, ROOTS, SELECTORS, Option, options
from trackmdp.config.compose import composed_values, known_options
from trackmdp.config.options import choices_of, listed, refuse, several
from trackmdp.config.refusals import refuse_renamed, unknown_choice, unknown_option
from trackmdp.errors import UserError

Compose = Callable[[Sequence[str]], DictConfig]


def diagnose(error: Exception, command: str, words: Sequence[str], compose: Compose) -> UserError:
    """The `UserError` that says which of the typed `words` Hydra's `error` is about.

    Args:
        error: what composing raised.
        command: the command.
        words: its overrides, as typed.
        compose: composes a config from overrides.
    """
    if isinstance(error, UserError):  # a file of the user's was refused
        return error
    try:
        # Composing stops at the first mistake in its own order, and its message names Hydra's internals. The words are
        # gone through again here, to name the one that is wrong with what was expected instead.
        overrides = [_read(word) for word in words]
    except UserError as misspelt:
        return misspelt
    # Hydra says that a sweep "requires --multirun"; nothing is wrong with the value itself.
    sweeps = [override.input_line for override in overrides if override.is_sweep_override()]
    if sweeps and ("multirun" in str(error).lower()):
        group, _, names = str(sweeps[0]).partition("=")
        if several(ROOTS[command], group) and "[" not in names:
            return UserError(f"{sweeps[0]}: expected {group}=[{names}]")
        return UserError(f"{sweeps[0]}: expected one value; add -m to run once for each")
    groups = [override for override in overrides if _of_group(override, command)]
    files = [override for override in overrides if _is_choice(override, command)]
    # Choices before values: with algo=pppo every algo.* would be unknown, though only the choice is wrong.
    for override in files:
        if refusal := _bad_file(override, error):
            return refusal
    for override in groups:
        if refusal := _bad_choice(override, error):
            return refusal
    # What options there are depends on the choices: in algo=a2c,ppo algo.epochs is an option of one of them. The first
    # combination that composes and shows a mistake decides.
    for choices in _jobs([*files, *groups]):
        try:
            values = composed_values(compose(choices), ROOTS[command])
        except Exception:  # the choices themselves are at fault; at the end Hydra's own message is reported
            continue
        known = dict(known_options(ROOTS[command], values))
        for override in overrides:
            if override not in [*files, *groups] and (refusal := _bad_value(override, known)):
                return refusal
    # No word is at fault: an interpolation, a defaults list or a user's file; Hydra's message is all there is.
    return UserError(_plain(error))


def _read(word: str) -> Override:
    """A word as Hydra reads it.

    Raises:
        UserError: it cannot be read, or it has the former name of an option or of a choice.
    """
    override = parsed(word)
    refuse_renamed(override.key_or_group)
    for value in _names(override):
        refuse_renamed(override.key_or_group, str(value))
    return override


def _of_group(override: Override, command: str) -> bool:
    """Whether a word chooses from one of the command's groups."""
    # A selector such as credit=joint picks a file within its group (`algo`), and belongs to the command if the group
    # does.
    key = override.key_or_group
    chosen = SELECTORS[key].group if key in SELECTORS else key
    return chosen in GROUPS and chosen in options(ROOTS[command])


def _bad_choice(override: Override, error: Exception) -> UserError | None:
    """The refusal of a choice that Hydra did not find."""
    group = override.key_or_group
    for value in _names(override):
        # Hydra says `find` of a single choice and `load` of one in a list.
        missing = any(f"Could not {verb} '{group}/{value}" in str(error) for verb in ("find", "load"))
        if not isinstance(value, str) or (value not in choices_of(group) and missing):
            return unknown_choice(group, value)
    return None


def _is_choice(override: Override, command: str) -> bool:
    """Whether a word chooses an experiment, a launcher or a sweeper: exactly one, by the name of a file."""
    key = override.key_or_group
    return key.startswith("hydra/") or (key == "experiment" and command == "train")


def _bad_file(override: Override, error: Exception) -> UserError | None:
    """The refusal of a choice that does not exist, or of several where one is expected; None if it is right."""
    key, values = override.key_or_group, values_of(override)
    if len(values) > 1:
        return UserError(f"{override.input_line}: expected one {key.split('/')[-1]}")
    said = str(error)
    if f"Could not find '{key}/{values[0]}'" not in said:
        return None
    # Hydra ends its message with one option a line, each after a tab. Schemas are stored as `base_...`, and are no
    # choices.
    tail = said.partition(f"Available options in '{key}':")[2].splitlines()[1:]
    names = [line.strip() for line in itertools.takewhile(lambda line: line.startswith("\t"), tail)]
    known = [name for name in names if not name.startswith("base_")]
    return refuse(key, values[0], f"one of {', '.join(known) or 'none, since there is none'}")


def _jobs(groups: Sequence[Override]) -> Iterator[list[str]]:
    """Every combination of the groups' choices, as overrides."""
    per_group = [
        [f"{each.key_or_group}={listed(value) if isinstance(value, list) else value}" for value in values_of(each)]
        for each in groups
    ]
    yield from (list(words) for words in itertools.product(*per_group))


def _bad_value(override: Override, known: dict[str, Option]) -> UserError | None:
    key = override.key_or_group
    # Hydra's own options have no schema of ours; `group@package` moves a choice to a place that is not known here.
    if key.split(".")[0] == "hydra" or "@" in key:
        return None
    if key not in known:
        if inner := [name for name in known if name.startswith(f"{key}.")]:
            return UserError(f"{override.input_line}: expected {inner[0]}=value (known: {', '.join(inner)})")
        return unknown_option(key, known)
    # Every option exists already: `+` would add a second meaning, `~` would leave a hole in the typed config.
    if override.is_delete() or override.is_add():
        return UserError(f"{override.input_line}: expected {key}=value, without + or ~")
    for value in values_of(override):
        if not known[key].allows(value):
            return refuse(key, value, known[key].expected)
    return None


def _names(override: Override) -> list[Any]:
    """The choices that a word makes; a list of a group of several is taken apart."""
    return [name for value in values_of(override) for name in (value if isinstance(value, list) else [value])]


def _plain(error: Exception) -> str:
    """The messages of an error and its cause in one line, without repetitions and hints on Hydra's syntax."""
    # Hydra wraps OmegaConf's error, and each says a part: where, and what.
    said = [str(each).strip() for each in (error, error.__cause__) if each is not None]
    lines = [line.strip(" .:") for text in said for line in text.splitlines()[:2]]
    told = [line for line in lines if line and not line.startswith(("To append", "full_key"))]
    return ": ".join(dict.fromkeys(told)) or type(error).__name__
