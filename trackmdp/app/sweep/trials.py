"""Sweeps with runs chosen by Optuna, one batch after the other; the study is kept and continued."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import optuna
from hydra.core.override_parser.types import IntervalSweep, Override, RangeSweep
from optuna.distributions import (
    BaseDistribution,
    CategoricalDistribution,
    FloatDistribution,
    IntDistribution,
)
from optuna.exceptions import ExperimentalWarning, StorageInternalError
from optuna.samplers import RandomSampler, TPESampler
from optuna.trial import BaseTrial, FrozenTrial, TrialState

from trackmdp.app.sweep.plan import Job, MakeJobs
from trackmdp.app.sweep.sweep import run_figures
from trackmdp.app.words import parsed, single_words, values_of
from trackmdp.config.sweeping import OptunaConfig
from trackmdp.errors import RunError, UserError
from trackmdp.seeding import derive
from trackmdp.training.folders import run_of
from trackmdp.untrusted import reason

STUDY = "study.db"
"""File in the sweep's folder that holds the study, where no other storage is named."""

_OTHER = "hydra.sweeper.study: the study is one of another search"
_DIRECTIONS = {"aihtr": "maximize", "regret_per_step": "minimize"}


def trials(
    cfg: OptunaConfig, words: Sequence[str], folder: Path, planned: MakeJobs
) -> Iterator[list[Job]]:
    """Batches of jobs, until `cfg.n_trials` are done; once a batch has been run, its results are handed to the study.

    Args:
        cfg: of the study.
        words: the typed ones; words with several values, `range(a,b)` or `interval(a,b)` are searched.
        folder: of the sweep.
        planned: makes jobs of words.

    Raises:
        UserError: there is nothing to search, or the study is one of another search.
        RunError: the study could not be read or written.
    """
    searched, fixed = _searched(cfg, words)

    def job_of(trial: BaseTrial) -> Job:
        # In the order of the line: a storage gives a trial's values in any.
        if trial.params.keys() != searched.keys():
            raise UserError(f"{_OTHER} ({', '.join(trial.params)})")
        chosen = [f"{key}={trial.params[key]}" for key in searched]
        return planned([[*fixed, *chosen]], searched)[0]

    with _study(cfg, folder) as study:
        earlier = [job_of(trial) for trial in _completed(study)]
        here = [job for job in earlier if job.folder.is_dir()]
        # A study of the folder's own knows no other runs: these would guide the search, and stand in no table.
        if cfg.storage is None and len(here) < len(earlier):
            raise UserError(
                f"{_OTHER} (other words, or another file, than those of this line; or its runs were removed), expected "
                "another hydra.sweep.dir, or hydra.sweeper.study=NAME beside it"
            )
        # Handed over as a batch of its own: the sweep finds them done, and they stand in its table.
        if here:
            yield here
        # Failures of earlier calls do not count: the user has perhaps removed the cause, and they are tried
        # once more.
        failed = 0
        # `n_trials` is the whole study's, so that a call that was interrupted and is repeated comes to the same
        # number; Optuna's own `optimize` would add so many each time.
        while (over := len(_completed(study)) + failed) < cfg.n_trials:
            places = range(min(cfg.batch, cfg.n_trials - over))
            asked = [_ask(cfg, study, searched, over, place) for place in places]
            jobs = [job_of(trial) for trial in asked]
            # A sampler may propose the same values twice within a batch: one run, with its result for both trials.
            yield list({job.name: job for job in jobs}.values())
            # The generator goes on only when the sweep asks for the next batch, after all runs of this one are over.
            for trial, job in zip(asked, jobs, strict=True):
                failed += _tell(cfg, study, trial, job)


def _searched(
    cfg: OptunaConfig, words: Sequence[str]
) -> tuple[dict[str, BaseDistribution], list[str]]:
    """Option -> its values, of the words that are searched; and the words that all trials have."""
    read = [parsed(word) for word in words]
    searched = {
        each.get_key_element(): _distribution(each) for each in read if each.is_sweep_override()
    }
    fixed = [word for word, each in zip(words, read, strict=True) if not each.is_sweep_override()]
    if not searched:
        raise UserError(
            "hydra/sweeper=optuna: expected a word to search, such as algo.gamma=interval(0.9,0.99)"
        )
    timed = [each.value() for each in read if each.get_key_element() == "optimal.time_limit"]
    if cfg.objective == "regret_per_step" and any(value is not None for value in timed):
        raise UserError(
            "optimal.time_limit: a regret would be chosen by the clock, expected null (or objective=aihtr)"
        )
    return searched, fixed


def _distribution(override: Override) -> BaseDistribution:
    """The values of a word that is searched, in the notation of Hydra's sweeps.

    Raises:
        UserError: there are none between its bounds, or too many.
    """
    value: Any = override.value()
    if isinstance(value, IntervalSweep):
        ends: Any = value.start, value.end  # never None by Hydra's grammar, possibly by its types
        (low, high), log = ends, "log" in value.tags
        if not (0 if log else -math.inf) < low < high < math.inf:
            raise UserError(
                f"{override.input_line}: expected interval(a,b) with {'0 < ' if log else ''}a < b"
            )
        # Hydra gives interval(1,8) bounds that are floats; int(interval(1,8)) has whole ones, and is searched in whole
        # numbers.
        return (IntDistribution if isinstance(low, int) else FloatDistribution)(low, high, log)
    words = single_words(override)
    if isinstance(value, RangeSweep):
        # A range may fall, range(8,0,-2); Optuna wants low to high.
        values = sorted(values_of(override))
        kind: Any = IntDistribution if isinstance(values[0], int) else FloatDistribution
        return kind(values[0], values[-1], step=abs(value.step))
    # As strings in Hydra's notation, since they become words: null, [1,2] and quoted text stay as they are.
    return CategoricalDistribution([word.partition("=")[2] for word in words])


def _ask(
    cfg: OptunaConfig, study: Any, searched: dict[str, BaseDistribution], over: int, place: int
) -> BaseTrial:
    """The next trial. Draws depend on the seed and on the results known, not on interruptions."""
    # A sampler's state is not kept in the storage. Seeded anew from the number of trials that are over, the choice
    # after an interruption is the one that would have come without it. Failed ones count: else they would be drawn
    # again. 2^32: NumPy takes no larger seed.
    seed = derive(cfg.seed, "optuna", over, place) % 2**32
    study.sampler = _sampler(cfg, seed)
    try:
        return study.ask(searched)
    except ValueError as error:
        raise UserError(f"{_OTHER} ({error})") from error


def _sampler(cfg: OptunaConfig, seed: int) -> Any:
    if cfg.sampler == "random":
        return RandomSampler(seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ExperimentalWarning)
        # Else a batch would be the same run many times.
        return TPESampler(seed=seed, constant_liar=cfg.batch > 1)


def _tell(cfg: OptunaConfig, study: Any, trial: Any, job: Job) -> int:
    """Report the result of a job to the study; returns 1 if it failed.

    An interrupted one stays open, and is enqueued again by the next call.
    """
    run = run_of(job.folder)
    value = run_figures(run).get(cfg.objective) if run.state == "done" else None
    if value is not None:
        study.tell(trial, value)
        return 0
    # Done without a figure counts as failed, as where the regret is searched on recorded tracks, which have no bound.
    if run.state in ("done", "failed"):
        study.tell(trial, state=TrialState.FAIL)
        return 1
    return 0


@contextmanager
def _study(cfg: OptunaConfig, folder: Path) -> Iterator[Any]:
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    where = cfg.storage or f"sqlite:///{folder / STUDY}"
    try:
        storage = optuna.storages.RDBStorage(where)
    except Exception as error:  # of many kinds, those of the data base's driver among them
        raise UserError(
            f"hydra.sweeper.storage={where}: expected a data base's URL ({reason(error)})"
        ) from error
    try:
        way = _DIRECTIONS[cfg.objective]
        study = optuna.create_study(
            study_name=cfg.study, storage=storage, direction=way, load_if_exists=True
        )
        if study.direction.name.lower() != way:
            raise UserError(f"{_OTHER} (hydra.sweeper.objective is not {cfg.objective})")
        _enqueue_interrupted(study)
        yield study
    except StorageInternalError as error:  # as on a full disk
        why = reason(error.__cause__ or error)
        raise RunError(f"hydra.sweeper.storage={where}: {why}") from error
    finally:
        # Else a connection to the SQLite file stays open until the interpreter ends.
        storage.remove_session()
        storage.engine.dispose()


def _enqueue_interrupted(study: Any) -> None:
    """Ask first for the trials of an earlier call that were interrupted or failed."""
    known = [trial.params for trial in study.trials if trial.state == TrialState.COMPLETE]
    known += [
        trial.system_attrs.get("fixed_params")
        for trial in study.trials
        if trial.state == TrialState.WAITING
    ]
    for trial in study.trials:
        # The process that asked for it is gone; its result will never come.
        if trial.state == TrialState.RUNNING:
            study.tell(trial.number, state=TrialState.FAIL)
        # `trial.state` is the state as listed above, so that a trial just marked as failed is still among those
        # here.
        stopped = trial.state in (TrialState.RUNNING, TrialState.FAIL)
        if stopped and trial.params not in known:
            study.enqueue_trial(trial.params)
            known.append(trial.params)


def _completed(study: Any) -> list[FrozenTrial]:
    return study.get_trials(deepcopy=False, states=[TrialState.COMPLETE])
