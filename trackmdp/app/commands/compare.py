"""`compare`: policies of runs and baselines side by side."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch

from trackmdp.config import CompareConfig, load_run_config
from trackmdp.durable import write_json
from trackmdp.training.compare import Comparison, compare
from trackmdp.training.display import make_console, table
from trackmdp.training.run import trained
from trackmdp.world.group import Group, Subject
from trackmdp.world.problem_file import problem_digest


def run(cfg: CompareConfig, folder: Path, problem: Subject) -> None:
    """Write `comparison.json`, and print the table and its conclusion.

    The problem is the first run's; without one, `cfg`'s. Where a run learned for several targets, all policies are
    compared for as many.
    """
    torch.set_num_threads(1)  # as in `evaluate`: networks of few rows wait long for more
    console, policies = make_console(cfg.quiet), dict[str, Any]()
    runs, baselines = cfg.runs or [], cfg.baselines or []
    count = max((load_run_config(each).targets.count for each in runs), default=1)
    found = [trained(each, torch.device("cpu"), targets=count) for each in runs]
    if found:
        problem = found[0][0]
    # A run's folder may have the name of another's, or of a baseline; then its whole path is shown.
    same = Counter([*(Path(each).name for each in runs), *baselines])
    for each, (own, policy, _) in zip(runs, found, strict=True):
        name = Path(each).name if same[Path(each).name] == 1 else each
        elsewhere = "" if _digest(own) == _digest(problem) else " (other problem)"
        policies[name + elsewhere] = policy
    policies |= {name: name for name in baselines}
    compared = compare(problem, policies)
    write_json(folder / "comparison.json", _report(compared))
    shown = any(each.difference.low is not None for each in compared.policies[1:])
    about = compared.about + (", 95 %" if compared.tracks is not None and shown else "")
    heads = ["policy", "AIHTR", "accuracy", "sensors per step", "AIHTR less the first"]
    rows = [[each.name, *compared.cells(each)] for each in compared.policies]
    console.print(table(about, heads, rows))
    for sentence in compared.sentences:
        console.print(sentence)
    console.print(f"results in {folder}")


def _digest(problem: Subject) -> str:
    """The digest of a problem, for policies of any memory."""
    if isinstance(problem, Group):
        return problem_digest(problem.but(memory="cell", clip=2))
    return problem_digest(replace(problem, memory="cell", clip=2))


def _report(compared: Comparison) -> dict[str, Any]:
    return {
        "tracks": compared.tracks,
        "policies": [asdict(each) for each in compared.policies],
        "conclusion": compared.sentences,
    }
