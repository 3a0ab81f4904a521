"""Evaluation of a policy on held-out tracks: its files and its table at the terminal."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.console import Console

from trackmdp.durable import write_json, write_text
from trackmdp.episodes.simulate import simulate
from trackmdp.policies.policy import Policy
from trackmdp.policies.saved import write_sets
from trackmdp.reports.held_out import recorded_page
from trackmdp.reports.picture import draw_picture
from trackmdp.training.display import table
from trackmdp.training.evaluator import CELL_ALONE, HeldOutEvaluator
from trackmdp.world.gridding import said
from trackmdp.world.tracks import Problem, Recorded


def run(world: Recorded, policy: Policy, subject: str, folder: Path, console: Console, seed: int) -> float:
    """Write `evaluation.json`, `sets.json`, `picture.txt` and `tracks.html` to `folder`.

    Returns:
        The mean reward of a track.
    """
    show_loaded(console, world)
    evaluator = HeldOutEvaluator(world)
    report = evaluator.report(policy)
    value = evaluator.evaluate(policy).value
    content = {"policy": subject, "held_out": report} | write_sets(folder, policy, value=value)
    content |= dict.fromkeys(("regret_per_step", "regret_per_step_lower"))
    write_json(folder / "evaluation.json", content)
    compared = {"policy": policy, **{n: p for n, p in evaluator.references.items() if n == CELL_ALONE}}
    # With one seed all of them meet the same targets.
    episodes = {name: simulate(world, each, 16, seed=seed) for name, each in compared.items()}
    write_text(folder / "picture.txt", draw_picture(episodes["policy"], world))
    replayed = {name: evaluator.replayed(each) for name, each in compared.items()}
    write_text(folder / "tracks.html", recorded_page(world, subject, report, replayed, episodes).html())
    show_held_out(console, subject, report)
    console.print(f"results in {folder}; the page is tracks.html")
    return float(report["figures"]["policy"]["aihtr"]["mean"])


def show_loaded(console: Console, problem: Problem) -> None:
    """What became of the positions in a file; nothing of a world, and of a file of cells."""
    if isinstance(problem, Recorded) and problem.loaded:
        console.print(f"loaded: {said(problem.loaded)}")


def show_held_out(console: Console, subject: str, report: dict[str, Any]) -> None:
    """The figures of a policy beside those of the references, with their intervals."""
    shown: dict[str, tuple[Any, ...]] = {"aihtr": ("AIHTR", 2), "reward_per_step": ("reward per step", 4)}
    shown |= {"accuracy": ("accuracy", 2, 100.0, " %"), "sensors_per_step": ("sensors per step", 2)}
    rows = []
    # Figure by figure, policies under each other: side by side the intervals would be wider than 80 columns.
    for key, (label, *form) in shown.items():
        rows.append([label, ""])
        for name, figures in report["figures"].items():
            rows.append([f"  {subject if name == 'policy' else name}", with_interval(figures[key], *form)])
    console.print(table(f"{report['tracks']} held-out tracks", ["", "mean (95 % interval)"], rows))


def with_interval(interval: dict[str, float | None], digits: int, scale: float = 1.0, unit: str = "") -> str:
    """A mean with its interval in brackets."""
    known = [interval[key] for key in ("mean", "low", "high")]
    mean, low, high = ("–" if value is None else f"{scale * value:,.{digits}f}" for value in known)
    return f"{mean}{unit} ({low} ... {high})"
