"""Computed figures on the paper's unstated settings, stored beside the results as `paper.json`."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

from trackmdp.durable import write_text
from trackmdp.paper import theorems
from trackmdp.paper.calibration import BORDER, T_MAX, Candidate, Setting, Spread, candidates, chosen, sensitivity
from trackmdp.paper.theorems import Check
from trackmdp.paper.worlds import COSTS, SUPPORTS, paper_kernel, paper_world
from trackmdp.solvers import optimal
from trackmdp.untrusted import decoded, read_object

OPENINGS_FILE = "paper.json"
TOLERANCE = 1e-9
# Z = 5 is where Q_MDP fails: each likely move has (1 - 0.15 - 0.005) / 4 = 0.211, below c/r = 0.22.
HARDEST = 5


@dataclass(frozen=True)
class Openings:
    """Candidate kernels, the effect of the unstated settings, and the statements checked."""

    candidates: list[Candidate]
    settings: list[Setting]
    checks: list[Check]


def compute(say: Callable[[str], None]) -> Openings:
    """All of it, in about half a minute; `say` is told what is under way."""
    say("candidate kernels for the paper's worlds")
    every = [candidate for support_size in SUPPORTS for candidate in candidates(support_size)]
    say("the paper's unstated settings")
    settings = list(sensitivity())
    say("the paper's theorems")
    found = checks(chosen(every)[HARDEST], border=BORDER, t_max=T_MAX)
    # Through the stored form even now: a report made from `paper.json` later has to give the same bytes as this one.
    return _unpacked(_packed(Openings(every, settings, found)))


def checks(seed: int, *, border: str, t_max: int) -> list[Check]:
    """The paper's theorems on the world with Z = 5 at the lowest price, and the two remarks."""
    world = paper_world(paper_kernel(HARDEST, seed, border), COSTS[0], t_max)  # type: ignore[arg-type]
    solution = optimal.solve(world, tolerance=TOLERANCE)
    return [*theorems.check_theorems(world, solution, TOLERANCE), *theorems.check_remarks(TOLERANCE)]


def save_openings(openings: Openings, folder: Path) -> None:
    """Write `paper.json`."""
    write_text(folder / OPENINGS_FILE, json.dumps(_packed(openings), separators=(",", ":"), ensure_ascii=False) + "\n")


def load_openings(folder: Path) -> Openings | None:
    """Read it back; None where there is none.

    Raises:
        UserError: it cannot be read.
    """
    file = folder / OPENINGS_FILE
    if not file.is_file():
        return None
    with decoded(str(file), "what a report says of the paper"):
        return _unpacked(read_object(file))


def _packed(openings: Openings) -> dict[str, Any]:
    return {name: [_rounded(astuple(each)) for each in found] for name, found in vars(openings).items()}


def _rounded(value: Any) -> Any:
    """Numbers of six digits, as further ones may differ from machine to machine; -inf ("no case"), as a text."""
    if isinstance(value, tuple):
        return [_rounded(each) for each in value]
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else repr(value)
    return value


def _unpacked(plain: dict[str, Any]) -> Openings:
    return Openings(
        [Candidate(*row) for row in plain["candidates"]],
        [
            Setting(border, t_max, z, cost, Spread(*accuracy), Spread(*qmdp), Spread(*clocked), deviation)
            for border, t_max, z, cost, accuracy, qmdp, clocked, deviation in plain["settings"]
        ],
        [Check(name, said, float(deviation), *rest) for name, said, deviation, *rest in plain["checks"]],
    )
