"""The result of a training run, in memory and in its folder."""

from __future__ import annotations

import csv
import json
import math
import platform
import time
from collections.abc import Mapping
from dataclasses import dataclass, fields
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch

from trackmdp import __version__
from trackmdp.algos.common import make_algorithm
from trackmdp.arrays.types import Array
from trackmdp.config import load_run_config
from trackmdp.config.tree import config_digest
from trackmdp.errors import UserError, path_of
from trackmdp.machine import torch_threads
from trackmdp.notebook.card import NONE, Card, Carded, decimal, grid_words
from trackmdp.policies.policy import Policy
from trackmdp.policies.saved import load_policy
from trackmdp.seeding import single_precision
from trackmdp.solvers import optimal
from trackmdp.solvers.evaluate import group_rule
from trackmdp.solvers.evaluation import Evaluation, figures
from trackmdp.solvers.several.group_tracker import Followed
from trackmdp.solvers.several.merging import Rule
from trackmdp.solvers.solution import Solution
from trackmdp.training import checkpoint
from trackmdp.training.callbacks import Callback, Learning, Row, Training
from trackmdp.training.devices import machine, reused_memory
from trackmdp.training.evaluator import Evaluator, Score, fixed_policies, while_collecting
from trackmdp.training.folders import SUMMARY, check_files, read_summary, write_summary
from trackmdp.training.group_run import Several, beside, learned_policy
from trackmdp.training.inputs import problem_of, with_own_classes
from trackmdp.training.state import PACKAGES, load_learned
from trackmdp.untrusted import LARGE, decoded, read_text
from trackmdp.world.group import Subject, group_of

_PROVED = ("lower", "upper", "certified", "timed_out")
Metrics = dict[str, list[float | int | None]]
"""Columns by their names, as in `metrics.csv`: one value for each logged iteration, None for missing figures."""


@dataclass(frozen=True, eq=False, repr=False)
class Run(Followed, Carded):
    """A training run that has ended.

    Attributes:
        policy: the learned one.
        evaluation: its figures, exact where there is a motion model, else on the held-out tracks.
        columns: figures by iteration, on recorded tracks those of the validation tracks; see `metrics`.
        summary: the content of `summary.json`.
        folder: where its files are; None where none were written.
        solution: the optimum, or a bracket of it, where it was solved for at the end.
        several: the policy for several targets beside the bracket, where there are several; None in a run that was
            loaded, whose `summary` has the figures.
    """

    policy: Policy
    evaluation: Evaluation
    columns: Metrics
    summary: dict[str, Any]
    folder: Path | None = None
    solution: Solution | None = None
    several: Several | None = None

    @property
    def metrics(self) -> Any:
        """The columns as a DataFrame, or as they are where pandas is not installed (extra `tracks`)."""
        if find_spec("pandas") is None:
            return self.columns
        from pandas import DataFrame

        return DataFrame(self.columns)

    @property
    def merge(self) -> str | None:
        """How it puts plans for several targets together, as of `targets.merge`; None: as is usual for them."""
        if self.several is not None:
            return self.several.merge
        return None if self.folder is None else load_run_config(self.folder).targets.merge

    @property
    def rule(self) -> Rule:
        """The policy for the run's several targets, as its figures have it.

        Raises:
            UserError: the run is of one target.
        """
        if self.several is not None:
            return group_rule(self.several.group, self)
        if self.folder is not None and (cfg := load_run_config(self.folder)).targets.count > 1:
            return group_rule(group_of(problem_of(cfg, self.folder), cfg.targets.count), self)
        raise UserError("tracker: a run of one target, expected run.policy.tracker(cell)")

    def card(self) -> Card:
        """Algorithm, budget, figures, bound and folder."""
        summary, task = self.summary, self.policy.task
        facts = {
            "size": f"{grid_words(task.size)}, T_max {task.t_max}",
            "budget": f"{summary.get('frames', 0):,} frames, seed {summary.get('seed')}",
        }
        bounds = summary.get("bounds") or {}
        if bounds.get("clocked") is not None:
            facts["bound"] = f"AIHTR at most {decimal(bounds['clocked'])} (clocked)"
        if optimal := summary.get("optimal"):
            proved = "certified" if optimal["certified"] else "not closed"
            facts["bound"] = f"AIHTR at most {decimal(optimal['upper'])} ({proved})"
        if (regret := decimal(summary.get("regret_per_step"), 4)) != NONE:
            facts["regret per step"] = regret  # on recorded tracks there is none
        facts["folder"] = "none, in memory" if self.folder is None else str(self.folder)
        shown = ("AIHTR", "accuracy", "sensors per step", "steps per episode")
        learned = self.evaluation.facts()
        facts |= {name: learned[name] for name in shown}
        return Card(f"Run: {summary.get('algo')}", facts)


class _Rows(Callback):
    """Keeps the rows of all iterations in memory."""

    def __init__(self) -> None:
        self.columns: Metrics = {}

    def on_update(self, trainer: Training, row: Row) -> None:  # noqa: ARG002
        """Append the row."""
        for key, value in row.items():
            self.columns.setdefault(key, []).append(value)


def complete(trainer: Learning) -> Run:
    """Train to the end, solve for the optimum where the config asks for it, and write `policy.npz` and `summary.json`.

    Raises:
        UserError, Preempted, RunError: see `trainer.Trainer.run`.
    """
    with torch_threads(trainer.config.threads), reused_memory():
        began, used = time.monotonic(), time.process_time()
        rows = _Rows()
        trainer.callbacks.append(rows)
        score = trainer.run()
        policy = trainer.policy()
        solution = _solve(trainer, policy)
        several = _several(trainer, policy, solution)
        if several is not None and trainer.problem.targets:
            score = several.score
        # Exact figures were scored already; on recorded tracks the held-out ones are looked at here for the first
        # time.
        recorded = trainer.problem.model is None and not trainer.problem.targets
        final = trainer.evaluator.evaluate(policy) if recorded else score.evaluation
        if solution is not None:  # the score keeps the evaluation that it is of
            score = trainer.evaluator.tighten(solution.lower, solution.upper, score)
        times = {
            "wall_seconds": time.monotonic() - began + trainer.start.seconds,
            "cpu_seconds": time.process_time() - used,
        }
        summary = summarize(trainer, final, score, solution, times)
        summary["several"] = None if several is None else several.report()
        if trainer.folder is not None:
            policy.save(trainer.folder / "policy.npz", final.value)
            # Last, for a folder with a summary is a finished run.
            write_summary(trainer.folder, summary)
        # A resumed run's earlier rows are in its file alone.
        columns = (trainer.folder and read_metrics(trainer.folder)) or rows.columns
        return Run(policy, final, columns, summary, trainer.folder, solution, several)


def _solve(trainer: Learning, learned: Policy) -> Solution | None:
    """The certified optimum, where it is asked for, of whole episodes, and where a detection reveals the state.

    The search also starts from the learned policy.
    """
    cfg, world = trainer.config.optimal, trainer.problem.model
    if not cfg.enabled or world is None or world.max_steps is not None or not world.tells_all:
        return None
    start = learned if learned.deterministic else None
    with trainer.console.status(f"solving for the optimum, at most {cfg.nodes:,} nodes"):
        found = optimal.solve(world, nodes=cfg.nodes, time_limit=cfg.time_limit, start=start)
    return found.uninterrupted()


def _several(trainer: Learning, policy: Policy, single: Solution | None) -> Several | None:
    """The policy for all targets beside the bracket, where there are several."""
    cfg = trainer.config
    if cfg.targets.count == 1:
        return None
    group = group_of(trainer.problem, cfg.targets.count)
    rule = group_rule(group, policy, *([] if cfg.algo.joint else [cfg.targets.merge]))
    console, text = trainer.console, "simulating all targets"
    if not console.is_terminal:  # where no status is shown; it may take minutes
        console.print(text)
    with console.status(text):
        return beside(rule, cfg.optimal, width=cfg.evaluation.width, seed=cfg.seed, single=single)


def load_run(folder: str | Path) -> Run:
    """A finished run from its folder.

    Raises:
        UserError: the folder is no finished run's, or a file in it is damaged.
    """
    place = path_of(folder, "load_run")
    if not (place / SUMMARY).is_file():
        raise UserError(f"run={folder}: not the folder of a finished run (it has no {SUMMARY})")
    summary = read_summary(place)
    check_files(place, summary)
    config = load_run_config(place)
    if config.targets.count > 1 and config.algo.joint:
        policy, value = trained(str(folder), torch.device("cpu"))[1], None
    else:
        table, value = load_policy(place / "policy.npz")
        policy = Policy.from_table(table)
    run = Run(policy, _evaluation(place, summary, value), read_metrics(place), summary, place)
    with decoded(str(place / SUMMARY), "the summary of a run"):
        run.card()  # else `repr` would be the first to find that a figure is missing or no number
    return run


def _evaluation(folder: Path, summary: Mapping[str, Any], value: Array | None) -> Evaluation:
    """The figures of the summary and the values of the policy; other figures per cell are not kept in a folder."""
    with decoded(str(folder / SUMMARY), "the summary of a run"):
        known = {field.name for field in fields(Evaluation)}
        value = np.empty(0) if value is None else value
        found: dict[str, Any] = dict.fromkeys(known, np.full(len(value), np.nan))
        found["value"] = value
        for name in known & summary["policy"].keys():
            number = summary["policy"][name]
            found[name] = math.nan if number is None else float(number)
        return Evaluation(**found)


def read_metrics(folder: Path) -> Metrics:
    """The columns of `metrics.csv`; none where the run wrote no such file."""
    file = folder / "metrics.csv"
    if not file.exists():
        return {}
    with decoded(str(file), "the metrics of a run"):
        rows = csv.DictReader(read_text(file, most=LARGE).splitlines(), strict=True)
        columns: Metrics = {name: [] for name in rows.fieldnames or ()}
        for row in rows:
            for name, column in columns.items():
                # As JSON reads it, a number is whole where it was: a float is logged with a point or an exponent.
                column.append(json.loads(row[name]) if row[name] else None)
    return columns


def summarize(
    trainer: Learning,
    final: Evaluation,
    score: Score,
    solution: Solution | None,
    times: dict[str, float],
) -> dict[str, Any]:
    """The figures of a run that has ended; on recorded tracks there are no bounds, no Q_MDP and no regret.

    Args:
        trainer: of the run.
        final: figures of the last policy.
        score: of the last policy, its regret to the best bound known by now; on recorded tracks it is of others than
            `final`, and stands under `validation`.
        solution: the optimum or a bracket of it, where it was solved for.
        times: seconds spent, by their names in the summary.
    """
    config, evaluator, end = trainer.config, trainer.evaluator, trainer.position
    return {
        "algo": config.algo.name,
        "seed": config.seed,
        "frames": end.frames,
        **times,
        "policy": figures(final),
        "validation": None if final is score.evaluation else figures(score.evaluation),
        "qmdp": figures(evaluator.qmdp) if evaluator.qmdp else None,
        "bounds": evaluator.bounds,
        "references": references(evaluator, solution),
        "optimal": solution and {key: getattr(solution, key) for key in _PROVED},
        "regret_per_step": score.regret_per_step,
        "regret_per_step_lower": score.regret_per_step_lower,
        "while_collecting": while_collecting(evaluator.upper, final, end.reward, end.frames),
        "held_out": evaluator.held_out(trainer.policy()),
        "place": place.facts() if (place := trainer.problem.task.place) else None,
        "versions": {"trackmdp": __version__, "python": platform.python_version()}
        | {name: version(name) for name in PACKAGES},
        "machine": machine(),
        "config_sha256": config_digest(config, trainer.folder),
    }


def references(evaluator: Evaluator, solution: Solution | None) -> dict[str, Any]:
    """Figures of the policies that a learned one is compared with, beside Q_MDP; none on recorded tracks."""
    if evaluator.qmdp is None:
        return {}
    fixed = fixed_policies(evaluator.world).items()
    found = {name: evaluator.evaluate(policy) for name, policy in fixed}
    if solution is not None:
        found["best known"] = solution.evaluation
    return {name: figures(each) for name, each in found.items()}


@single_precision()
def trained(
    run: str, device: torch.device, *, best: bool = False, targets: int | None = None
) -> tuple[Subject, Any, str]:
    """Where a run learned, the policy of its newest checkpoint, or of the best one, and its name.

    A run by blocks has no checkpoint: the policy is the one in `policy.npz`.

    Args:
        run: its folder.
        device: of networks.
        best: take the best checkpoint.
        targets: of at least so many, and as many as the run has, the plans are merged, as it asks for; None: they are
            returned as they were learned.

    Raises:
        UserError: that is no run, or the checkpoint is missing, damaged or another run's.
    """
    cfg, folder = load_run_config(run), Path(run)
    world = problem_of(cfg, folder)
    if cfg.partition.block is not None:
        if best:
            raise UserError(
                f"checkpoint=best: expected newest for run={run}, whose blocks have checkpoints of their own"
            )
        policy: Any = load_run(folder).policy
        source = "by blocks"
    else:
        own = with_own_classes(cfg, folder)
        algorithm = make_algorithm(own, world.task, device, targets=world.targets)
        file = folder / "checkpoints" / checkpoint.BEST if best else checkpoint.newest(folder)
        load_learned(algorithm, cfg, world, file, device)
        policy, source = learned_policy(world, algorithm.actor, device), file.name
    if targets is not None and (count := max(targets, cfg.targets.count)) > 1:
        world = group_of(world, count)
        policy = group_rule(world, policy, cfg.targets.merge)
    return world, policy, f"{cfg.algo.name}, {source}"
