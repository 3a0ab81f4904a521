"""Turn what Hydra says about a mistyped option into one line: key, value, and what was expected."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Glob, Override
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf

from trackmdp.config import GROUPS, ROOTS, SELECTORS, Option, options
from trackmdp.config.options import listed, several
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
        parsed = [_parse(word) for word in words]
    except UserError as misspelt:
        return misspelt
    # Hydra says that a sweep "requires --multirun"; nothing is wrong with the value itself.
    sweeps = [override.input_line for override in parsed if override.is_sweep_override()]
    if sweeps and ("multirun" in str(error).lower()):
        group, _, names = str(sweeps[0]).partition("=")
        if _many(group, command) and "[" not in names:
            return UserError(f"{sweeps[0]}: expected {group}=[{names}]")
        return UserError(f"{sweeps[0]}: expected one value; add -m to run once for each")
    groups = [override for override in parsed if _group(override, command)]
    files = [override for override in parsed if _is_choice(override, command)]
    # Choices before values: with algo=pppo every algo.* would be unknown, though only the choice is wrong.
    for override in files:
        if refusal := _bad_file(override, error):
            return refusal
    for override in groups:
        if refusal := _bad_choice(override, _group(override, command), error):
            return refusal
    # What options there are depends on the choices: in algo=a2c,ppo algo.epochs is an option of one of them. The first
    # combination that composes and shows a mistake decides.
    for overrides in _jobs([*files, *groups]):
        known = _known(command, overrides, compose)
        if known is None:
            continue
        for override in parsed:
            if override not in [*files, *groups] and (refusal := _bad_value(override, known)):
                return refusal
    # No word is at fault: an interpolation, a defaults list or a user's file; Hydra's message is all there is.
    return UserError(_plain(error))


def _parse(word: str) -> Override:
    """A word as Hydra reads it.

    Raises:
        UserError: it cannot be read, or it has the former name of an option or of a choice.
    """
    try:
        override = OverridesParser.create().parse_override(word)
        names = _names(override)
    except (HydraException, ValueError) as error:  # ValueError: an integer of thousands of digits, range(0,1,0)
        raise UserError(f"{word}: expected option=value (a value with blanks or commas needs quotes)") from error
    refuse_renamed(override.key_or_group)
    for value in names:
        refuse_renamed(override.key_or_group, str(value))
    return override


def _group(override: Override, command: str) -> str:
    """The group a word chooses from, `""` if it sets a value."""
    # A selector such as credit=joint picks a file within its group (`algo`), and belongs to the command if the group
    # does.
    key = override.key_or_group
    chosen = SELECTORS[key].group if key in SELECTORS else key
    return key if chosen in GROUPS and chosen in options(ROOTS[command]) else ""


def _many(group: str, command: str) -> bool:
    """Whether any number of choices may be made of the group: ``log=[csv,mcap]``."""
    return group in GROUPS and group in options(ROOTS[command]) and several(ROOTS[command], group)


def _bad_choice(override: Override, group: str, error: Exception) -> UserError | None:
    """The refusal of a choice that Hydra did not find."""
    known = SELECTORS[group].choices if group in SELECTORS else GROUPS[group]
    for value in _names(override):
        # Hydra says `find` of a single choice and `load` of one in a list.
        missing = any(f"Could not {verb} '{group}/{value}" in str(error) for verb in ("find", "load"))
        if not isinstance(value, str) or (value not in known and missing):
            return unknown_choice(group, value)
    return None


def _is_choice(override: Override, command: str) -> bool:
    """Whether a word chooses an experiment, a launcher or a sweeper: exactly one, by the name of a file."""
    key = override.key_or_group
    return key.startswith("hydra/") or (key == "experiment" and command == "train")


def _bad_file(override: Override, error: Exception) -> UserError | None:
    """The refusal of a choice that does not exist, or of several where one is expected; None if it is right."""
    key, values = override.key_or_group, _values(override)
    if len(values) > 1:
        return UserError(f"{override.input_line}: expected one {key.split('/')[-1]}")
    said = str(error)
    if f"Could not find '{key}/{values[0]}'" not in said:
        return None
    # Hydra ends its message with one option a line, each after a tab. Schemas are stored as `base_...`, and are no
    # choices.
    listed = said.partition(f"Available options in '{key}':")[2].splitlines()[1:]
    names = [line.strip() for line in itertools.takewhile(lambda line: line.startswith("\t"), listed)]
    known = [name for name in names if not name.startswith("base_")]
    return UserError(f"{key}={_shown(values[0])}: expected one of {', '.join(known) or 'none, since there is none'}")


def _jobs(groups: Sequence[Override]) -> Iterator[list[str]]:
    """Every combination of the groups' choices, as overrides."""
    per_group = [
        [f"{each.key_or_group}={listed(value) if isinstance(value, list) else value}" for value in _values(each)]
        for each in groups
    ]
    yield from (list(words) for words in itertools.product(*per_group))


def _known(command: str, overrides: Sequence[str], compose: Compose) -> dict[str, Option] | None:
    """Dotted key -> option of the config with these choices; None where it cannot be composed."""
    try:
        return dict(_options_of(compose(overrides), ROOTS[command], ""))
    except Exception:  # the choices themselves are at fault; the caller reports Hydra's own message
        return None


def _options_of(node: Any, schema: type[Any], prefix: str) -> Iterator[tuple[str, Option]]:
    for name, item in options(schema).items():
        if isinstance(item, Option):
            yield f"{prefix}{name}", item
            continue
        # `node[name]` would resolve interpolations and raise at values that are missing; only the type is asked for.
        child = node._get_node(name)
        if several(schema, name):
            for each in child:
                chosen = child._get_node(each)
                yield from _options_of(chosen, OmegaConf.get_type(chosen) or item, f"{prefix}{name}.{each}.")
            continue
        kind = OmegaConf.get_type(child) if isinstance(child, DictConfig) and not child._is_none() else None
        if kind is not None:
            yield from _options_of(child, kind, f"{prefix}{name}.")


def _bad_value(override: Override, known: dict[str, Option]) -> UserError | None:
    key = override.key_or_group
    # Hydra's own options have no schema of ours; `group@package` moves a choice to a place that is not known here.
    if key.split(".")[0] == "hydra" or "@" in key:
        return None
    if key not in known:
        return _unknown(override, known)
    # Every option exists already: `+` would add a second meaning, `~` would leave a hole in the typed config.
    if override.is_delete() or override.is_add():
        return UserError(f"{override.input_line}: expected {key}=value, without + or ~")
    for value in _values(override):
        if not known[key].allows(value):
            return UserError(f"{key}={_shown(value)}: expected {known[key].expected}")
    return None


def _unknown(override: Override, known: dict[str, Option]) -> UserError:
    """The refusal of a key that does not exist, with the keys that do."""
    key = override.key_or_group
    if inner := [name for name in known if name.startswith(f"{key}.")]:
        return UserError(f"{override.input_line}: expected {inner[0]}=value (known: {', '.join(inner)})")
    refuse_renamed(key)
    return unknown_option(key, known)


def _values(override: Override) -> list[Any]:
    """The value, or those of a sweep."""
    value = override.value()
    # What glob(*) stands for only Hydra's loader of configs knows.
    if override.is_sweep_override() and override.is_discrete_sweep() and not isinstance(value, Glob):
        return list(override.sweep_iterator())
    return [value]


def _names(override: Override) -> list[Any]:
    """The choices that a word makes; a list of a group of several is taken apart."""
    return [name for value in _values(override) for name in (value if isinstance(value, list) else [value])]


def _shown(value: Any) -> Any:
    return "null" if value is None else value


def _plain(error: Exception) -> str:
    """The messages of an error and its cause in one line, without repetitions and hints on Hydra's syntax."""
    # Hydra wraps OmegaConf's error, and each says a part: where, and what.
    said = [str(each).strip() for each in (error, error.__cause__) if each is not None]
    lines = [line.strip(" .:") for text in said for line in text.splitlines()[:2]]
    told = [line for line in lines if line and not line.startswith(("To append", "full_key"))]
    return ": ".join(dict.fromkeys(told)) or type(error).__name__
