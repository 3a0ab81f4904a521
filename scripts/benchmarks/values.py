"""Figures of random worlds of all kinds, here and with the package of another checkout."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.clock import HERE, checkout
from benchmarks.words import Row
from trackmdp.errors import UserError


def rows(
    words: Mapping[str, str],
    beside: str = "",
    count: int = 500,
    seed: int = 0,
) -> Iterator[Row]:
    """One row for each kind of world: the most by which figures here differ from those of the checkout `beside`.

    `exact` is of the values of a random policy in every cell, its accuracy and sensors per step, and of Q_MDP's AIHTR;
    `lower` and `upper` are of the solver's bracket, here less there: less than 0 is a worse policy here, more than 0 a
    worse bound. All are shares of the figure there, or of 1 where that is smaller.

    Raises:
        UserError: words about the world, which is drawn; or the checkout has no package.
    """
    if words:
        raise UserError(f"{min(words)}: unknown with part=values, which draws its worlds")
    here, there = (_printed(place, count, seed) for place in (HERE, checkout(beside)))
    for kind in dict.fromkeys(each["kind"] for each in here):
        pairs = [pair for pair in zip(here, there, strict=True) if pair[0]["kind"] == kind]
        row: Row = {"kind": kind, "worlds": len(pairs)}
        row["exact"] = max(float(abs(_share("exact", *pair)).max()) for pair in pairs)
        solved = pairs if "lower" in pairs[0][0] else []  # no world with max_steps is
        row["lower"] = min((_share("lower", *pair) for pair in solved), default=None)
        row["upper"] = max((_share("upper", *pair) for pair in solved), default=None)
        row["certified"] = sum(here["certified"] for here, _ in solved)
        row["certified_beside"] = sum(there["certified"] for _, there in solved)
        yield row


def _printed(place: str, count: int, seed: int) -> list[dict[str, Any]]:
    """The figures of `drawn.py` with the package of a checkout."""
    program = [sys.executable, str(Path(__file__).with_name("drawn.py")), str(count), str(seed)]
    own = {**os.environ, "PYTHONPATH": place, "PYTHONSAFEPATH": "1"}
    done = subprocess.run(program, check=True, stdout=subprocess.PIPE, env=own)
    return [json.loads(line) for line in done.stdout.splitlines()]


def _share(name: str, here: dict[str, Any], there: dict[str, Any]) -> Any:
    """How much more a figure is here, as a share of the figure there."""
    mine, other = np.array(here[name]), np.array(there[name])
    return (mine - other) / np.maximum(1.0, abs(other))
