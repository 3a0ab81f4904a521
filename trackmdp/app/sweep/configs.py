"""Configs of the runs of a sweep: Hydra composes once for all runs that differ in numbers alone."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path

from hydra.core.override_parser.types import OverrideType, ValueType
from omegaconf import DictConfig, OmegaConf

from trackmdp.app.words import Compose, parsed
from trackmdp.config import ROOTS, CommandConfig
from trackmdp.config.checks import refuse_ignored
from trackmdp.config.compose import composed_values, config_of
from trackmdp.config.registry import unresolved
from trackmdp.config.resume import by_key
from trackmdp.errors import UserError


class Configs:
    """The checked configs of some lists of words.

    Hydra takes a tenth of a second to compose, so that a composition is kept. In it the numbers of other words are put
    in their places before interpolations are resolved, which may refer to them.

    Args:
        command: of the runs.
        compose: the config of some words.
    """

    def __init__(self, command: str, compose: Compose) -> None:
        self._root, self._compose = ROOTS[command], compose
        self._composed: dict[tuple[str, ...], DictConfig] = {}

    def __call__(self, words: Sequence[str]) -> tuple[CommandConfig | None, str]:
        """The config of `words`, after every check that needs no file; or None and the reason of its refusal.

        Raises:
            UserError: the words make no config.
        """
        # ["algo=ppo", "seed=3"] -> ("algo=ppo", "seed")
        form = tuple(next(iter(_number(word)), word) for word in words)
        if form not in self._composed:
            values = composed_values(self._compose(words), self._root)
            self._composed[form] = unresolved(values)
        composed = self._composed[form]
        for word in words:
            for key, number in _number(word).items():
                OmegaConf.update(composed, key, number)
        try:
            cfg = config_of(composed, self._root, Path.cwd())
            if not getattr(cfg, "resume", None):  # a run that goes on has a config of its own
                refuse_ignored(cfg, by_key(words))
        except UserError as error:
            return None, str(error)
        return cfg, ""


@cache  # of many runs the same; to read one takes as long as to fill a config
def _number(word: str) -> dict[str, int | float]:
    """The option that a word sets to a number; empty for other words."""
    override = parsed(word)
    plain = override.type is OverrideType.CHANGE and override.value_type is ValueType.ELEMENT
    value = override.value() if plain else None
    return {override.get_key_element(): value} if isinstance(value, (int, float)) else {}
