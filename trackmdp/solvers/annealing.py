"""Deterministic annealing of a policy (Rose 1998): from chances to sets, with exact gains.

Every sensor of every plan is on with a chance of its own. Its *advantage* is what its being on gains over its being
off, all other chances given. At a temperature T its chance is the logistic function of advantage / T; as T falls to
nothing, chances become sets, each a best answer to the others. Policy iteration on sets changes some whole plans at
once and stops where two would have to change together. Here all move together, by little each, and most such stops are
passed by.
"""

from __future__ import annotations

import numpy as np
from scipy.special import expit

from trackmdp.arrays.types import Array
from trackmdp.solvers.renewal import Renewal
from trackmdp.solvers.search import Found, credit_of

_STEPS, _HOT, _WARM, _COLD = 40, 0.2, 0.03, 0.01
"""Temperatures; the first one, where the optimistic credit leads as well; and the last, in rewards (without, in D)."""
_LEAST = 1e-100  # reward: gains in smaller ones would be no numbers
_SPREAD = 3.0
"""Standard deviation of advantage / T at first: of almost any sets."""
_OFF, _LED = 0.05, 0.7
"""Standard deviation by which advantages are off at first, in the same, and the share of the steps that are led."""


def anneal(renewal: Renewal, rng: np.random.Generator, *, led: bool = False) -> Found:
    """The policy at the end of all temperatures, from random chances.

    Args:
        renewal: the problem.
        rng: draws the chances.
        led: whether the clocked bound's credit leads, as in the homotopy of `search`, with errors that fade. Both
            kinds are needed: where a safe action misses this one ends lower, and higher where it does not.
    """
    world = renewal.world
    unit = max(world.reward or world.safe_cost, _LEAST)
    odds, off = (
        [spread * rng.standard_normal((len(choice.rows), 1)) for choice in renewal.choices]
        for spread in (_SPREAD, _OFF * unit)
    )
    credit, policy = credit_of(world) if led else None, None
    for step, temperature in enumerate(np.geomspace(_WARM if led else _HOT, _COLD, _STEPS)):
        share = max(0.0, 1.0 - step / (_LED * _STEPS)) if led else 0.0
        chances = _chances(renewal, odds)
        policy = Found(renewal, chances, policy)
        plans = policy.plans(credit)
        advantages = plans.advantages(chances, share)
        # Half of the odds before are kept: best answers of all sensors at once overshoot.
        odds = [
            (before + (gain + share * error) / (temperature * unit)) / 2
            for before, gain, error in zip(odds, advantages, off, strict=True)
        ]
    sets = [chance > 0.5 for chance in _chances(renewal, odds)]
    return Found(renewal, plans.ascend(sets, sweeps=1), policy)


def _chances(renewal: Renewal, odds: list[Array]) -> list[Array]:
    """`[G, 1]` for each free choice; 0 of sensors that may not be on."""
    found = []
    for choice, each in zip(renewal.choices, odds, strict=True):
        chance = expit(each)
        found.append(chance if choice.allowed is None else chance * choice.allowed)
    return found
