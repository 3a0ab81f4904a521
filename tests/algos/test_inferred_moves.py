"""Expected moves through cells that no sensor covers."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import trackmdp as tm
from tests.helpers import collect
from trackmdp.algos.segments import InferredMoves
from trackmdp.policies.policy import Policy

# A target walks 0 1 2 and leaves, with a mode that a detection reveals: mode 0 skips cell 1. No sensor is in cell 1.
KERNEL = np.zeros((6, 6))
KERNEL[0, 4] = KERNEL[1, 3] = KERNEL[2, 5] = KERNEL[3, 4] = 1.0
LINE = tm.World(
    KERNEL, (1, 3), cost=[0.1, np.nan, 0.1], safe_cost=0.2, t_max=1, modes=2, reveals=True
)


PRICES = np.full(9, 0.16)
PRICES[4] = np.nan
ROAM = tm.make_world("heading", size=3, cost=PRICES, reveals=True)


def inferred(envs: int = 64) -> InferredMoves:
    made = InferredMoves(LINE.task, torch.Generator().manual_seed(0))
    made.extend(collect(LINE, Policy.all_on(LINE), envs, 40))
    return made


def test_hidden_states_are_those_that_explain_what_was_sensed() -> None:
    """From (0, mode 1) the target is missed once, in cell 1, and then in (2, mode 0)."""
    paths = {tuple(path) for path in inferred().paths(600, 3).T.tolist()}
    assert (0, 4, 6, 6) in paths
    assert {path for path in paths if path[0] == 1} == {(1, 3, 4, 6)}


def test_moves_are_inferred_alike_in_whatever_pieces_and_whenever_asked_for() -> None:
    batch = collect(ROAM, Policy.all_on(ROAM), 32, 20)
    whole, pieces = (InferredMoves(ROAM.task, torch.Generator().manual_seed(0)) for _ in range(2))
    whole.extend(batch)
    for part in batch.split(16):
        pieces.extend(part)
        pieces.moves()
    resumed = InferredMoves(ROAM.task, torch.Generator().manual_seed(0))
    resumed.load_state_dict(pieces.state_dict())
    expected = whole.paths(20_000, 3)
    assert torch.equal(pieces.paths(20_000, 3), expected)
    assert torch.equal(resumed.paths(20_000, 3), expected)
    assert len(resumed) == len(whole) > 100


@pytest.mark.slow
def test_hindsight_learns_with_told_modes_and_a_cell_without_a_sensor() -> None:
    run = tm.train(ROAM, "hindsight", seed=5)
    found, best = tm.evaluate(ROAM, run.policy), tm.solve(ROAM)
    assert (best.lower - found.aihtr) / found.expected_length < 0.01
