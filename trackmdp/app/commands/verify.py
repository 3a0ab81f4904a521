"""`verify`: check the paper's theorems on a world."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Column, Table

from trackmdp.config import VerifyConfig
from trackmdp.durable import write_json
from trackmdp.errors import RunError
from trackmdp.paper import theorems
from trackmdp.paper.check import summarize_checks
from trackmdp.solvers import hidden, optimal
from trackmdp.training.display import make_console
from trackmdp.world.model import World
from trackmdp.world.problem import Problem, check_sensors, modelled

NODES = 10_000_000
"""Work for the optimum the theorems are about: two minutes or so."""


def run(cfg: VerifyConfig, folder: Path, world: Problem) -> None:
    """Write `verification.json` to `folder`.

    Raises:
        RunError: a claim fails.
    """
    console = make_console(cfg.quiet)
    known = modelled(world, "verify")
    check_sensors(known)
    verify_world(known, cfg.tolerance, folder, console)


def verify_world(world: World, tolerance: float, folder: Path, console: Console) -> None:
    """Solve the world, with sensors of one cell, run every check, write `verification.json`, and show it.

    Raises:
        RunError: a claim fails.
    """
    with console.status("checking the paper's theorems"):
        if world.modes > 1:
            solution = optimal.solve(world) if world.tells_all else hidden.solve(world)
            found = theorems.check_modes(world, solution.uninterrupted(), tolerance)
        else:
            solution = optimal.solve(world, nodes=NODES, tolerance=tolerance)
            found = theorems.check_theorems(world, solution.uninterrupted(), tolerance)
    checks = [*found, *theorems.check_remarks(tolerance)]
    optimum = {name: getattr(solution, name) for name in ("lower", "upper", "certified")}
    rows = [each._asdict() | {"verdict": each.verdict, "passed": each.passed} for each in checks]
    content = {"optimum": optimum, "tolerance": tolerance, "checks": rows}
    write_json(folder / "verification.json", content)
    # Two lines of `not claimed; does not hold`, to leave room for statements.
    verdict = Column("verdict", max_width=13)
    title = "the paper's theorems"
    shown = Table("statement", "deviation", verdict, title=title, title_justify="left")
    for each in checks:
        note = f" ({each.note})" if each.note else ""
        off = "–" if np.isneginf(each.deviation) else f"{each.deviation:.2g}"
        shown.add_row(f"{each.name}: {each.statement}{note}", off, each.verdict)
    console.print(shown)
    summary = f"{summarize_checks(checks)}; results in {folder}"
    console.print(summary)
    if not all(each.passed for each in checks):
        raise RunError(summary)
