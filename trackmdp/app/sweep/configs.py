"""Configs of the runs of a sweep: Hydra composes once for all runs that differ in numbers alone."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from hydra.core.override_parser.types import OverrideType, ValueType
from omegaconf import DictConfig, OmegaConf

from trackmdp.app.words import Compose, parsed
from trackmdp.config import ROOTS, CommandConfig
from trackmdp.config.checks import refuse_ignored, validate
from trackmdp.config.compose import from_hydra
from trackmdp.config.options import as_float, leaves
from trackmdp.config.resume import by_key
from trackmdp.config.tree import flatten
from trackmdp.errors import UserError

Numbers = dict[str, int | float]
"""Dotted option -> its value."""


class Configs:
    """The checked configs of some lists of words.

    Hydra takes a tenth of a second to compose. A number that no other value of the config refers to, such as a seed,
    is put in its place in a config that is composed already.

    Args:
        command: of the runs.
        compose: the config of some words.
    """

    def __init__(self, command: str, compose: Compose) -> None:
        self._command, self._compose = command, compose
        self._read: dict[str, Numbers] = {}
        self._tied: set[str] = set()
        self._known: dict[tuple[str, ...], CommandConfig] = {}

    def __call__(self, words: Sequence[str]) -> tuple[CommandConfig | None, str]:
        """The config of `words`, after every check that needs no file; or None and the reason of its refusal.

        Raises:
            UserError: the words make no config.
        """
        key, numbers = self._split(words)
        known = self._known.get(key)
        composed: Any = self._compose(words) if known is None else None
        try:
            if known is not None:
                cfg = _changed(known, numbers)
            else:
                cfg = from_hydra(composed, ROOTS[self._command], Path.cwd())
                self._keep(words, numbers, cfg, composed)
            if not getattr(cfg, "resume", None):  # a run that goes on has a config of its own
                refuse_ignored(cfg, by_key(words))
        except UserError as error:
            return None, str(error)
        return cfg, ""

    def _split(self, words: Sequence[str]) -> tuple[tuple[str, ...], Numbers]:
        """The words without their numbers, and the numbers."""
        numbers: Numbers = {}
        key = []
        for word in words:
            found = self._number(word)
            numbers |= found
            key.append(next(iter(found), word))
        return tuple(key), numbers

    def _number(self, word: str) -> Numbers:
        """The option that a word sets to a number; empty for other words, and for options that others refer to."""
        if word not in self._read:
            override = parsed(word)
            plain = (
                override.type is OverrideType.CHANGE and override.value_type is ValueType.ELEMENT
            )
            value: Any = override.value() if plain else None
            is_number = isinstance(value, (int, float))
            self._read[word] = {override.get_key_element(): value} if is_number else {}
        found = self._read[word]
        return {} if self._tied & found.keys() else found

    def _keep(
        self, words: Sequence[str], numbers: Numbers, cfg: CommandConfig, composed: DictConfig
    ) -> None:
        """Keep a config for other numbers, where all of them can be put in their places."""
        kinds, referred = _kinds(cfg), _referred(composed)
        for key, value in numbers.items():
            kind = kinds.get(key)
            fits = kind in (type(value), Any) or (type(value), kind) == (int, float)
            if referred & {*key.split(".")} or not fits:
                self._tied.add(key)
        self._known[self._split(words)[0]] = cfg


def _kinds(cfg: CommandConfig) -> dict[str, Any]:
    return {key: described.kind for key, described, _ in leaves(cfg)}


def _changed(cfg: CommandConfig, numbers: Numbers) -> CommandConfig:
    """A config with other numbers, checked.

    Raises:
        UserError: it is refused.
    """
    kinds = _kinds(cfg)
    for key, value in numbers.items():
        number = as_float(value) if kinds[key] is float and type(value) is int else value
        cfg = _replaced(cfg, key.split("."), number)
    validate(cfg)
    return cfg


def _referred(composed: DictConfig) -> set[str]:
    """Last names of the options and nodes that interpolations refer to: `total_frames` of `${algo.total_frames}`."""
    plain: Any = OmegaConf.to_container(composed, resolve=False)
    plain.pop("hydra", None)
    texts = (str(value) for value in flatten(plain).values())
    names = (name for text in texts if "${" in text for name in re.findall(r"[\w.]+", text))
    return {name.rpartition(".")[2] for name in names}


def _replaced(node: Any, path: Sequence[str], value: Any) -> Any:
    """A copy of a config with another value at a path."""
    name, *rest = path
    if isinstance(node, dict):  # of several choices: log.csv.every
        return {**node, name: _replaced(node[name], rest, value)}
    return replace(node, **{name: _replaced(getattr(node, name), rest, value) if rest else value})
