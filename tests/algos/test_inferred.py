"""Moves to and from cells that no sensor covers."""

from __future__ import annotations

import numpy as np
import torch

from tests.algos.hindsight import assert_same
from tests.helpers import collect
from trackmdp.algos.inferred import InferredMoves
from trackmdp.policies.policy import Policy
from trackmdp.world.model import World

LINE = World(np.roll(np.eye(3), 1, axis=1) * 0.9, (1, 3), cost=0.1, t_max=1, coverage=[[1, 0, 0], [0, 0, 1], [1, 0, 1]])
"""0 -> 1 -> 2 -> 0, each but for an exit; no sensor covers cell 1."""


def _filled(count: int) -> InferredMoves:
    buffer = InferredMoves(LINE.task, torch.Generator().manual_seed(0))
    for batch in collect(LINE, Policy.all_on(LINE), 64, 8 * count, seed=0).split(8, dim=1):
        buffer.extend(batch)
    return buffer


def test_what_misses_tell_is_counted() -> None:
    """Whoever is missed after 0 was in 1; one in ten exits, from wherever it is."""
    buffer = _filled(8)
    start, end = buffer.moves()
    found = {(int(i), int(j)): float(n) for i, j, n in zip(start, end, buffer.counts(), strict=True) if n > 0.5}
    assert set(found) == {(0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3)}
    for start_cell in range(3):
        left, went = found[start_cell, 3], found[start_cell, (start_cell + 1) % 3]
        assert abs(left / (left + went) - 0.1) < 0.03
    paths = buffer.paths(3000, 3)
    assert set(paths[1][paths[0] == 0].tolist()) == {1, 3}
    assert set(paths[1][paths[0] == 1].tolist()) == {2, 3}
    stays = (paths[1] < 3).float().mean()
    assert abs(float(stays) - 0.9) < 0.03


def test_what_is_inferred_depends_on_nothing_but_the_observations() -> None:
    """Asked on the way, and begun anew from its state, it ends with the same moves."""
    whole, asked = _filled(6), InferredMoves(LINE.task, torch.Generator().manual_seed(0))
    batches = collect(LINE, Policy.all_on(LINE), 64, 48, seed=0).split(8, dim=1)
    for batch in batches[:3]:
        asked.extend(batch)
    asked.moves()
    resumed = InferredMoves(LINE.task, torch.Generator().manual_seed(0))
    resumed.load_state_dict(asked.state_dict())
    for batch in batches[3:]:
        resumed.extend(batch)
    assert len(resumed) == len(whole)
    assert_same([whole.moves(), whole.counts()], [resumed.moves(), resumed.counts()])
    assert_same(whole.paths(50, 3), resumed.paths(50, 3))
