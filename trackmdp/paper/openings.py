"""Computed figures on the paper's unstated settings, stored beside the results as `paper.json`."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from trackmdp.durable import write_text
from trackmdp.errors import UserError
from trackmdp.paper import critique
from trackmdp.paper.calibration import BORDER, T_MAX, Candidate, Setting, Spread, candidates, chosen, sensitivity
from trackmdp.paper.theorems import Check
from trackmdp.paper.worlds import SUPPORTS

OPENINGS_FILE = "paper.json"
_DIGITS = 6


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
    found = critique.checks(chosen(every)[critique.HARDEST], border=BORDER, t_max=T_MAX)
    # Through the stored form even now: a report made from `paper.json` later has to give the same bytes as this one.
    return _unpacked(_packed(Openings(every, settings, found)))


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
    try:
        return _unpacked(json.loads(file.read_text(encoding="utf-8")))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"{file}: cannot be read ({' '.join(str(error).split())})") from error


def _packed(openings: Openings) -> dict[str, Any]:
    return {
        "candidates": [
            [c.support_size, c.seed, round(c.deviation, _DIGITS), [round(a, _DIGITS) for a in c.accuracy]]
            for c in openings.candidates
        ],
        "settings": [
            [
                s.border,
                s.t_max,
                s.support_size,
                s.cost,
                *map(_spread, (s.accuracy, s.qmdp, s.clocked)),
                _short(s.deviation),
            ]
            for s in openings.settings
        ],
        # Two digits: further ones of a deviation at rounding level say nothing. As text, since JSON has no -inf ("no
        # case").
        "checks": [asdict(c) | {"deviation": repr(float(f"{c.deviation:.2g}"))} for c in openings.checks],
    }


def _unpacked(plain: dict[str, Any]) -> Openings:
    return Openings(
        [Candidate(z, seed, tuple(accuracy), deviation) for z, seed, deviation, accuracy in plain["candidates"]],
        [
            Setting(border, t_max, z, cost, Spread(*first), Spread(*second), Spread(*third), deviation)
            for border, t_max, z, cost, first, second, third, deviation in plain["settings"]
        ],
        [Check(**{**entry, "deviation": float(entry["deviation"])}) for entry in plain["checks"]],
    )


def _spread(spread: Spread) -> list[float]:
    return [_short(value) for value in (spread.median, spread.low, spread.high)]


def _short(value: float) -> float:
    return float(f"{value:.6g}")
