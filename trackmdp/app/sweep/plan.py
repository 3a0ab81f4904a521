"""From the words of a sweep to its jobs: every combination of values, each checked, each with its own folder."""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import re
import shlex
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

from hydra.core.override_parser.types import OverrideType, ValueType
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.progress import track

from trackmdp.app.words import MOST, Compose, parsed, single_words
from trackmdp.config import ROOTS, CommandConfig, TrainConfig, to_dict
from trackmdp.config.checks import by_content, refuse_ignored
from trackmdp.config.compose import composed_values, config_of
from trackmdp.config.registry import unresolved
from trackmdp.config.resume import by_key, fixed_options, key_of
from trackmdp.config.sweeping import BlocksConfig
from trackmdp.errors import UserError

_T = TypeVar("_T")
_MANY = 100
"""Runs from which on progress is shown."""

_UNNAMED = ("experiment", "quiet", "resume")
"""Keys that are left out of a folder's readable name: they do not change a result, or stand for other words."""


@dataclass(frozen=True)
class Job:
    """One run of a sweep: it can be handed to another process.

    Attributes:
        command: the command to run.
        sweep: the sweep's folder.
        name: of the run's folder in it.
        words: the overrides of this run.
        cfg: its checked config; None where it was refused.
        refusal: why.
        label: place in the sweep, for the terminal: ``3/60``.
        concurrent: other runs go on at the same time, so its output goes to a file of its own.
    """

    command: str
    sweep: Path
    name: str
    words: tuple[str, ...]
    cfg: CommandConfig | None
    refusal: str = ""
    label: str = ""
    concurrent: bool = False

    @property
    def folder(self) -> Path:
        """Of the run."""
        return self.sweep / self.name


def progress(items: Sequence[_T], done: str, console: Console | None) -> Iterable[_T]:
    """The items; where they are many, their number so far is shown."""
    if console is None or len(items) < _MANY:
        return items
    return track(items, f"{len(items):,} runs {done}", console=console, transient=True)


MakeJobs = Callable[..., list[Job]]
"""`plan` for one command, sweep and composer: called with a grid of words, and `naming`."""


def grid(
    cfg: BlocksConfig,
    words: Sequence[str],
    folder: Path,  # noqa: ARG001
    planned: MakeJobs,
) -> list[list[Job]]:
    """One batch with the whole grid.

    Raises:
        UserError: all of its runs would be refused, for one reason.
    """
    jobs = planned(combinations(cfg.blocks or [], words))
    refusals = {job.refusal for job in jobs}
    if len(refusals) == 1 and any(refusals):
        raise UserError(refusals.pop())
    return [jobs]


def combinations(blocks: Sequence[str], typed: Sequence[str]) -> list[list[str]]:
    """The words of every run: each block is a grid; typed words are added to it, or replace it.

    Args:
        blocks: lines of words such as ``algo=a2c,ppo seed=range(5)``; without any, the typed words are the grid.
        typed: the words of the command line, without those to Hydra.

    Raises:
        UserError: a word is not `option=value`, or its values cannot be counted.
    """
    found: dict[tuple[str, ...], None] = {}
    for block in list(blocks) or [""]:
        axes: dict[str, list[str]] = {}
        # `posix=False` keeps quotes: they are for Hydra's parser, which reads the word next.
        for word in [*shlex.split(block, posix=False), *typed]:
            override = parsed(word)
            if override.key_or_group == "experiment" and override.is_sweep_override():
                raise UserError(f"{word}: expected one experiment; each is a sweep of its own")
            # By key: typed words come last, and replaces the word of the block. `algo=a2c,ppo seed=0,1` makes the
            # axes {algo: [algo=a2c, algo=ppo], seed: [seed=0, seed=1]}.
            axes[override.key_or_group] = single_words(override)
        # Counted before they are listed: the list might fill the memory.
        if (runs := math.prod(map(len, axes.values()))) > MOST:
            raise UserError(f"a sweep of {runs:,} runs: expected at most {MOST:,}")
        # A dict, as a set that keeps its order: blocks may overlap, and a run that is in two of them is one run.
        found |= dict.fromkeys(itertools.product(*axes.values()))
    return [list(words) for words in found]


def plan(
    command: str,
    sweep: Path,
    compose: Compose,
    grid: Sequence[Sequence[str]],
    naming: Collection[str] = (),
    console: Console | None = None,
    concurrent: bool = False,
) -> list[Job]:
    """The jobs of a sweep, without duplicates.

    A run's folder is named by its differences from the others, and by a digest of its overrides and of the
    config behind it. Options that may change when a run is resumed (`CHANGEABLE`) count only where overridden.

    Args:
        command: the command to run.
        sweep: the sweep's folder.
        compose: the config of some words.
        grid: the words of each run.
        naming: options with values that name the folders; by default the ones that differ in the grid.
        console: where progress is shown.
        concurrent: whether several of them run at once.

    Raises:
        UserError: words that do not make a config; a config that is refused is kept, as a job that fails.
    """
    naming, known = naming or _varying(grid), _folders(sweep)
    jobs: dict[str, Job] = {}
    configs = Configs(command, compose)
    for words in progress(grid, "planned", console):
        # Only composing may refuse the whole sweep; a config out of range is a failed run among others, and is shown
        # as one.
        cfg, refusal = configs(words)
        try:
            cfg = cfg and _resumable(cfg)
        except UserError as error:
            cfg, refusal = None, str(error)
        # Words and config: where a default in conf/, or a file, has changed, the same words make another run.
        key = _digest(_distinguishing(words), _identity(cfg))
        text = _slug([word for word in words if key_of(word) in naming] or words)
        # A wider grid varies more options, so the readable part of a run's name may change; its digest does not, and
        # finds the folder that is there.
        name = known.get(key, f"{text}-{key}".lstrip("-"))
        # Lines that differ only in the order of their words, or in `quiet` and `resume`, are one run: two would write
        # to one folder at once.
        jobs.setdefault(key, Job(command, sweep, name, tuple(words), cfg, refusal))
    return [
        replace(job, label=f"{place}/{len(jobs)}", concurrent=concurrent)
        for place, job in enumerate(jobs.values(), 1)
    ]


def sweep_name(command: str, words: Sequence[str], blocks: Sequence[str]) -> str:
    """The name of a sweep's folder: the same for the same words in any order; words with many values first."""
    told = _distinguishing(words)
    # Stable sort: False comes first, so that words with several values lead and survive the cut at 80 letters.
    text = _slug(
        sorted(told, key=lambda word: not parsed(word).is_sweep_override()),
        [by_key(told).get("experiment", command)],
    )
    return f"{text}-{_digest(command, told, list(blocks))}"


def _varying(grid: Sequence[Sequence[str]]) -> set[str]:
    """The options that differ between the runs of a grid, or are missing in some."""
    runs = list(map(by_key, grid))
    keys = {key for run in runs for key in run}
    return {key for key in keys if len({run.get(key) for run in runs}) > 1}


def _folders(sweep: Path) -> dict[str, str]:
    """Digest -> name of the folders that are there: a run is known by its digest alone."""
    names = [path.name for path in sweep.iterdir() if path.is_dir()] if sweep.is_dir() else []
    return {name.rpartition("-")[2]: name for name in sorted(names)}


def _slug(words: Iterable[str], prefix: Sequence[str] = ()) -> str:
    """Words as a readable part of a folder's name."""
    named = {key: _short(text) for key, text in by_key(words).items() if key not in _UNNAMED}
    # `algo.gamma` is shown as `gamma`, unless another option of the runs ends alike.
    short = [key.split(".")[-1] for key in named]
    pairs = {
        key if short.count(last) > 1 else last: named[key]
        for key, last in zip(named, short, strict=True)
    }
    parts = [*prefix, *(f"{key}_{value}" for key, value in pairs.items())]
    # Only letters that no file system, shell or glob takes for its own; 80 of them leave room below the usual 255.
    return "-".join(re.sub(r"[^\w.+-]+", "_", part).strip("_") for part in parts)[:80].strip("-._")


def _short(value: str) -> str:
    """A value, rounded to 4 digits if it is a long number: names need not be exact, since digests differ."""
    return f"{float(value):.4g}" if re.fullmatch(r"-?\d*\.\d{5,}(e-?\d+)?", value) else value


def _distinguishing(words: Iterable[str]) -> list[str]:
    return sorted(word for word in words if key_of(word) not in ("quiet", "resume"))


def _digest(*told: Any) -> str:
    # 8 hex digits: 32 bits, so that among 1000 runs two meet with a chance of 1 in 8600.
    return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()[:8]


def _identity(cfg: CommandConfig | None) -> dict[str, Any]:
    """The options, and contents of files, by which two configs are different runs; empty for a refused config."""
    # Options that may change when a run is resumed do not make another run; typed ones do, as words.
    if isinstance(cfg, TrainConfig):
        return fixed_options(by_content(cfg))
    return (
        {} if cfg is None else {key: value for key, value in to_dict(cfg).items() if key != "quiet"}
    )


def _resumable(cfg: CommandConfig) -> CommandConfig:
    """The runs of a sweep resume where they were interrupted, each in its own folder."""
    if not isinstance(cfg, TrainConfig):
        return cfg
    if cfg.resume not in (None, "auto"):
        raise UserError(
            f"resume={cfg.resume}: expected null or auto in a sweep: its runs go on in their own folders"
        )
    return replace(cfg, resume="auto")


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
            cfg = config_of(composed, self._root)
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
