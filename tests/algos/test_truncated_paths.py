"""Episodes that are truncated after a miss: their last path is a censored one, not none."""

from __future__ import annotations

import numpy as np
import pytest

from tests.helpers import collect, hop_world
from trackmdp.algos.estimates.kernel_estimate import KernelEstimate
from trackmdp.algos.observed import observed_paths
from trackmdp.policies.policy import Policy
from trackmdp.policies.table import PolicyTable
from trackmdp.world.model import World


def sensing_the_last(world: World) -> Policy:
    """The sensor of the last cell alone is always on."""
    sets = np.zeros((world.num_keys, world.num_choices, world.num_cells), dtype=bool)
    sets[..., -1] = True
    return Policy.from_table(PolicyTable.from_dense(world, sets))


@pytest.mark.parametrize(("max_steps", "t_max"), [(1, 1), (2, 2), (4, 0)])
def test_moves_are_counted_that_end_unseen(max_steps: int, t_max: int) -> None:
    """From either of two cells the target comes to the other one half of the time; one of them is never sensed.

    Without the paths that are truncated after a miss it would come to the sensed one too often.
    """
    world = World(np.full((2, 2), 0.45), (1, 2), cost=0.1, safe_cost=0.2, t_max=t_max)
    batch = collect(world, sensing_the_last(world), 500, 40, max_steps=max_steps)
    estimate = KernelEstimate((1, 2), weight=0.1, exit_weight=1.0)
    estimate.add(observed_paths(batch, world))
    estimate.fit(400)
    assert estimate.mean()[:, :2].toarray() == pytest.approx(world.kernel.toarray(), abs=0.02)


def test_every_step_is_on_a_path() -> None:
    """Four cells in a circle, the last one sensed: from 3 and from 0 on it is not reached in two steps."""
    world = hop_world(t_max=2)
    batch = collect(world, sensing_the_last(world), 64, 10, max_steps=2)
    paths, after = observed_paths(batch, world), batch["next"]
    cut = paths.end == 5
    assert {*zip(paths.start[cut].tolist(), paths.misses[cut].tolist(), strict=True)} == {
        (0, 2),
        (3, 1),
        (3, 2),
    }
    sets = paths.sensed.toarray().reshape(-1, 3, 4)
    assert not sets[..., :3].any()
    assert (sets[..., 3].sum(axis=1) == paths.misses).all()
    going_on = after["steps_since_detection"][:, -1] * ~after["done"][:, -1, 0]
    assert paths.misses.sum() + (~cut).sum() + going_on.sum() == batch.numel()
