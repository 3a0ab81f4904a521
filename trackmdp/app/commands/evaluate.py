"""`evaluate`: value a trained policy or a baseline, exactly and by simulation."""

from __future__ import annotations

import shlex
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.table import Table

from trackmdp.app.commands.evaluate_false_alarms import evaluate_believed
from trackmdp.app.commands.evaluate_playback import evaluate_playback
from trackmdp.config import (
    EvaluateConfig,
    FalseAlarmConfig,
    McapConfig,
    PlaybackConfig,
    load_run_config,
    to_yaml,
)
from trackmdp.durable import write_json, write_text
from trackmdp.episodes.batch import Episodes
from trackmdp.episodes.log import EpisodeLog
from trackmdp.episodes.player import draw_picture
from trackmdp.episodes.simulate import simulate
from trackmdp.episodes.simulated_figures import Simulation
from trackmdp.machine import make_device
from trackmdp.notebook.card import counted_words
from trackmdp.policies.policy import Policy
from trackmdp.policies.saved import sets_name, write_sets
from trackmdp.recordings.gridding import said
from trackmdp.recordings.tracks import Recorded
from trackmdp.reports.held_out import recorded_page
from trackmdp.solvers.evaluate import evaluate, group_rule
from trackmdp.solvers.evaluation import figures
from trackmdp.solvers.several.group_bounds import upper_bound
from trackmdp.solvers.several.group_figures import with_ends
from trackmdp.solvers.several.group_value import evaluate_group
from trackmdp.solvers.solve import baseline_policy
from trackmdp.training.display import FIGURES, make_console, show_held_out, table
from trackmdp.training.evaluator import CELL_ALONE, ExactEvaluator, HeldOutEvaluator
from trackmdp.training.folders import SUMMARY, check_files, read_summary
from trackmdp.training.run import trained
from trackmdp.world.group import Group, Subject, group_of
from trackmdp.world.model import World
from trackmdp.world.problem import Problem

_FOR_THE_PICTURE = 16  # episodes simulated where none are asked for


def run(cfg: EvaluateConfig, folder: Path, problem: Problem) -> float:
    """Write `evaluation.json`, and without false alarms `sets.json` and `picture.txt`; returns the exact AIHTR.

    `problem` is the world of `cfg`; a trained policy is evaluated in its run's.
    """
    console = make_console(cfg.quiet)
    torch.set_num_threads(cfg.threads)
    device = make_device(cfg.device)
    believed = isinstance(cfg.sensor, FalseAlarmConfig)
    world: Subject
    if cfg.run:
        world, policy, subject = trained(cfg.run, device, targets=cfg.targets.count)
    elif isinstance(cfg.baseline, PlaybackConfig) and not believed:
        return evaluate_playback(cfg, cfg.baseline, problem, folder, console)
    else:
        assert cfg.baseline is not None
        world, policy, subject = problem, baseline_policy(problem, cfg.baseline), cfg.baseline.name
        if cfg.targets.count > 1:
            world = group_of(problem, cfg.targets.count)
    if isinstance(world, Group):
        return _several(cfg, world, policy, subject, folder, console)
    if believed:
        return evaluate_believed(cfg, world, policy, subject, folder, console)
    # Recorded tracks have no kernel, hence no exact value and no bound: figures come from the held-out tracks.
    if isinstance(world, Recorded):
        return _held_out(cfg, world, policy, subject, folder, console)
    return _exact(cfg, world, policy, subject, folder, console)


def _exact(
    cfg: EvaluateConfig,
    world: World,
    policy: Policy,
    subject: str,
    folder: Path,
    console: Console,
) -> float:
    """Evaluate with the motion model."""
    evaluator = ExactEvaluator(world)
    # The run's own summary has measured against its own proof; the same world gets the same regret here.
    proved = _proved(cfg.run) if cfg.run else None
    score = evaluator.score(policy)
    if proved:
        score = evaluator.tighten(proved["lower"], proved["upper"], score)
    episodes = simulate(world, policy, cfg.episodes or _FOR_THE_PICTURE, seed=cfg.seed)
    simulation = episodes.figures() if cfg.episodes else None
    report = {
        "policy": subject,
        "exact": figures(score.evaluation),
        "simulated": asdict(simulation) if simulation else None,
        "qmdp": figures(evaluator.qmdp),
        "bounds": evaluator.bounds,
        "regret_per_step": score.regret_per_step,
        "regret_per_step_lower": score.regret_per_step_lower,
        "optimal": proved,
    }
    write_json(
        folder / "evaluation.json",
        report | write_sets(folder, policy, value=score.evaluation.value),
    )
    write_text(folder / "picture.txt", draw_picture(episodes, world))
    console.print(_compared(subject, report, simulation))
    source = "run's bracket" if proved else "clocked"
    console.print(f"upper bound ({source}) {evaluator.upper:,.4f}; {score.regret}")
    sets = folder / sets_name(policy)
    listed = f", sets in {sets.name}" if sets.is_file() else ""  # not of sets drawn at random
    console.print(f"results in {folder}{listed}")
    _log(cfg, episodes, subject, folder, console)
    return score.evaluation.aihtr


def _several(
    cfg: EvaluateConfig, group: Group, policy: Any, subject: str, folder: Path, at: Console
) -> float:
    """Evaluate for several targets: `evaluation.json`; returns the AIHTR."""
    rule = group_rule(group, policy, cfg.targets.merge)
    with at.status("simulating all targets"):
        found = evaluate_group(rule, width=cfg.evaluation.width, seed=cfg.seed)
    apart, recorded, upper = None, group.recorded, upper_bound(group)
    if rule.tables:  # else it was learned for all targets together
        # On recorded tracks each is in one of the groups, some of which have fewer targets.
        each = len(group) if recorded is None else len(recorded.held_out) / len(found.totals)
        apart = each * evaluate(group.single, rule.tables[0]).aihtr
    report = {"policy": subject, "targets": len(group), "merge": rule.name, **found.report()}
    write_json(folder / "evaluation.json", report | {"apart": apart, "upper": upper})
    rows = [
        [FIGURES.get(name, name.replace("_", " ")), with_ends(each)]
        for name, each in found.figures.items()
    ]
    rows += [] if apart is None else [["AIHTR of separate trackers", f"{apart:,.4f}"]]
    rows += [] if recorded else [["upper bound", f"{upper:,.4f}"]]
    how = f"merged by {rule.name}" if rule.tables else "learned together"
    at.print(table(f"{subject}, {len(group)} targets, {how}", ["figure", found.about], rows))
    below = f"{(upper - found.aihtr.mean) / found.expected_length:.4f} per step below the bound; "
    at.print(f"{'' if recorded else below}results in {folder}")
    shown = (cfg.episodes if cfg.log else 0) or _FOR_THE_PICTURE
    episodes = simulate(group, rule, shown, seed=cfg.seed)
    write_text(folder / "picture.txt", draw_picture(episodes[:_FOR_THE_PICTURE], group.task))
    _log(cfg, episodes, subject, folder, at)
    return found.aihtr.mean


def _log(
    cfg: EvaluateConfig,
    episodes: Episodes,
    subject: str,
    folder: Path,
    console: Console,
) -> None:
    """Write `episodes.mcap` where it is asked for."""
    if not isinstance(mcap := cfg.log.get("mcap"), McapConfig):
        return
    config = to_yaml(load_run_config(cfg.run) if cfg.run else cfg)
    log = EpisodeLog(
        folder, episodes.problem, seed=cfg.seed, config=config, layout=mcap.layout, tell=_tell
    )
    try:
        log.add(episodes, {"label": subject})
        whole = log.close()
    except (KeyboardInterrupt, SystemExit):  # of Ctrl-C, or of another signal
        log.abandon()
        line = f"trackmdp replay {shlex.quote(f'file={log.part}')} recover=true"
        _tell(f"{log.part}: cut off; `{line}` saves its episodes")
        raise
    if whole:
        along = " along held-out tracks" if episodes.problem.recorded else ""
        console.print(f"{counted_words(log.episodes, 'episode')}{along} in {log.file}")


def _held_out(
    cfg: EvaluateConfig,
    world: Recorded,
    policy: Policy,
    subject: str,
    folder: Path,
    console: Console,
) -> float:
    """Evaluate on held-out tracks: `evaluation.json`, `sets.json`, `picture.txt`, `tracks.html`.

    Returns:
        The mean reward of a track.
    """
    if world.loaded:
        console.print(f"loaded: {said(world.loaded)}")
    evaluator = HeldOutEvaluator(world)
    report = evaluator.held_out(policy)
    value = evaluator.evaluate(policy).value
    content = {"policy": subject, "held_out": report} | write_sets(folder, policy, value=value)
    content |= dict.fromkeys(("regret_per_step", "regret_per_step_lower"))
    write_json(folder / "evaluation.json", content)
    compared = {
        "policy": policy,
        **{n: p for n, p in evaluator.references.items() if n == CELL_ALONE},
    }
    # With one seed all of them meet the same targets.
    episodes = {
        name: simulate(world, each, _FOR_THE_PICTURE, seed=cfg.seed)
        for name, each in compared.items()
    }
    write_text(folder / "picture.txt", draw_picture(episodes["policy"], world))
    replayed = {name: evaluator.replayed(each) for name, each in compared.items()}
    write_text(
        folder / "tracks.html", recorded_page(world, subject, report, replayed, episodes).html()
    )
    show_held_out(console, subject, report)
    console.print(f"results in {folder}; the page is tracks.html")
    if cfg.log:
        _log(cfg, simulate(world, policy, cfg.episodes, seed=cfg.seed), subject, folder, console)
    return float(report["figures"]["policy"]["aihtr"]["mean"])


def _tell(line: str) -> None:
    sys.stderr.write(f"trackmdp evaluate: {line}\n")


def _proved(run: str) -> dict[str, Any] | None:
    """`lower` and `upper` of the optimum as the run in the folder `run` proved them; None where it has not (yet).

    Raises:
        UserError: the summary is damaged, or of another run.
    """
    folder = Path(run)
    if not (folder / SUMMARY).is_file():
        return None
    summary = read_summary(folder)
    # `trained` has compared the kernel with the config; the bracket is of the world that these describe.
    check_files(folder, summary, "config.yaml")
    optimal = summary["optimal"]
    return optimal and {name: optimal[name] for name in ("lower", "upper")}


def _compared(subject: str, report: dict[str, Any], simulation: Simulation | None) -> Table:
    """The figures of the policy, exact and simulated, beside those of Q_MDP."""
    rows = []
    for key, label in FIGURES.items():
        estimate = getattr(simulation, key) if simulation else None
        simulated = f"{estimate.mean:,.4f} ± {estimate.standard_error:.4f}" if estimate else ""
        rows.append(
            [label, f"{report['exact'][key]:,.4f}", simulated, f"{report['qmdp'][key]:,.4f}"]
        )
    title = f"{simulation.episodes} simulated ± s.e." if simulation else "simulated"
    return table(subject, ["figure", "exact", title, "Q_MDP exact"], rows)
