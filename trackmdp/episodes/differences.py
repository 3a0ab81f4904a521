"""Where two recordings of an episode part."""

from __future__ import annotations

import numpy as np

from trackmdp.episodes.episode import Episode

SCALARS = ("seed", "policy", "start", "start_mode", "terminated", "truncated")
PER_STEP = ("target", "mode", "misses", "action", "located", "reward", "probability", "belief")


def first_difference(
    logged: Episode, again: Episode, *, belief_tolerance: float = 0.0
) -> str | None:
    """Where two recordings of an episode part, in words; None where every bit is the same.

    Args:
        logged: one of them.
        again: the other.
        belief_tolerance: differences of the belief up to this one pass.
    """
    pairs = zip(logged.singles(), again.singles(), strict=True)
    for k, (mine, other) in enumerate(pairs):
        if found := _first(mine, other, belief_tolerance):
            return f"target {k}, {found}" if logged.several else found
    return None


def _first(logged: Episode, again: Episode, belief_tolerance: float) -> str | None:
    """See `first_difference`; of one target."""
    for name in SCALARS:
        mine, other = getattr(logged, name), getattr(again, name)
        if mine != other:
            return f"{name}: logged {mine}, re-simulated {other}"
    steps = min(len(logged), len(again))
    known = [name for name in PER_STEP if name != "mode" or logged.mode is not None]
    found = (_differing(logged, again, name, steps, belief_tolerance) for name in known)
    if first := min(filter(None, found), key=lambda each: each[0], default=None):
        return f"step {first[0]}, {first[1]}"
    if len(logged) != len(again):
        return f"length: logged {len(logged)} steps, re-simulated {len(again)}"
    return None


def _differing(
    logged: Episode, again: Episode, name: str, steps: int, tolerance: float
) -> tuple[int, str] | None:
    """The first step at which the arrays called `name` differ, and how."""
    mine, other = getattr(logged, name)[:steps], getattr(again, name)[:steps]
    differs = mine != other
    if name == "belief" and tolerance:
        differs = ~(np.abs(mine - other) <= tolerance)  # so that a NaN differs from every number
    if not differs.any():
        return None
    where = tuple(int(each) for each in np.argwhere(differs)[0])
    cell = f" of cell {where[1]}" if len(where) > 1 else ""
    return where[0], f"{name}{cell}: logged {mine[where]}, re-simulated {other[where]}"
