"""`verify`: check the paper's theorems on a world."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from trackmdp.config import VerifyConfig
from trackmdp.durable import write_json
from trackmdp.errors import RunError, UserError
from trackmdp.paper import theorems
from trackmdp.paper.check import Check, summarize_checks
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
    if cfg.grid.max_steps is not None:
        raise UserError(
            f"grid.max_steps={cfg.grid.max_steps}: theorems are on whole episodes, expected null"
        )
    known = modelled(world, "verify")
    check_sensors(known)
    with console.status("checking the paper's theorems"):
        checks = write_checks(known, cfg.tolerance, folder)
    show_checks(console, checks, folder)


def write_checks(world: World, tolerance: float, folder: Path) -> list[Check]:
    """Solve the world, with sensors of one cell, run every check, and write `verification.json`."""
    if world.modes > 1:
        solution = optimal.solve(world) if world.tells_all else hidden.solve(world)
        found = theorems.check_modes(world, solution, tolerance)
    else:
        solution = optimal.solve(world, nodes=NODES, tolerance=tolerance)
        found = theorems.check_theorems(world, solution, tolerance)
    if solution.interrupted:
        raise KeyboardInterrupt
    checks = [*found, *theorems.check_remarks(tolerance)]
    content = {
        "optimum": {
            "lower": solution.lower,
            "upper": solution.upper,
            "certified": solution.certified,
        },
        "tolerance": tolerance,
        "checks": [
            check._asdict() | {"verdict": check.verdict, "passed": check.passed} for check in checks
        ],
    }
    write_json(folder / "verification.json", content)
    return checks


def show_checks(console: Console, checks: list[Check], folder: Path) -> None:
    """The table of all checks, and how many claims hold.

    Raises:
        RunError: one fails.
    """
    shown = Table(title="the paper's theorems", title_justify="left")
    shown.add_column("statement")
    shown.add_column("deviation")
    shown.add_column(
        "verdict", max_width=13
    )  # two lines of `not claimed; does not hold`, to leave room for statements
    for check in checks:
        note = f" ({check.note})" if check.note else ""
        off = "–" if np.isneginf(check.deviation) else f"{check.deviation:.2g}"
        shown.add_row(f"{check.name}: {check.statement}{note}", off, check.verdict)
    console.print(shown)
    summary = f"{summarize_checks(checks)}; results in {folder}"
    console.print(summary)
    if not all(check.passed for check in checks):
        raise RunError(summary)
