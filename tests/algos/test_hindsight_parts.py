"""Tables too large to be held at once are gone through in parts, a few located cells at a time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.algos.hindsight import FORMS, total
from tests.helpers import algorithm, small_world
from trackmdp.algos.hindsight_loss import HindsightLoss
from trackmdp.motion.kernels import random_walk
from trackmdp.sensing.coverage import discs
from trackmdp.world.model import World

ENTRIES = 5 * 3 * 25
"""Five located cells of a 5x5 grid with three clocks, each output standing for a cell."""


def far_world() -> World:
    return replace(small_world(5, t_max=2), cost=np.linspace(0.1, 0.5, 25))


def alike_world() -> World:
    kernel = random_walk(9, stay=0.2, diagonal=False, exit_probability=0.02, border="renormalize")
    return World(kernel, 9, cost=np.full(81, 0.16), safe_cost=81 * 0.16, t_max=0)


def gradients(
    world: World, form: str, reach: int, max_entries: int, *, share_cells: bool = False
) -> tuple[dict[str, Tensor], list[Tensor], Tensor]:
    """Losses, gradients and running gains in the second of two updates, and how many parts there were."""
    rng = torch.Generator().manual_seed(3)
    m, t = world.num_cells, world.t_max
    loss = HindsightLoss(
        world.task,
        FORMS[form](),
        reach=reach,
        hidden=2,
        discount=0.7,
        generator=rng,
        classes=np.zeros(m, dtype=int) if share_cells else None,
        max_entries=max_entries,
    )
    optimizer = torch.optim.SGD(loss.parameters(), lr=0.1)
    for update in range(2):
        optimizer.step()
        loss.actor_loss.prepare(update, 0.0)
        optimizer.zero_grad()
        cells = torch.arange(300) % m
        steps = [
            (cells + (step > 1) * torch.randint(2, (300,), generator=rng)).clamp(max=m)
            for step in range(t + 3)
        ]
        cells = torch.stack(steps)
        cells = torch.where((cells == m).cummax(0).values, m, cells)
        on = torch.rand(m, t + 1, loss.sensors.width, generator=rng) < 0.3
        losses = total(loss, cells, on, 0.6)
        torch.stack(list(losses.values())).sum().backward()
    grads = [weight.grad for weight in loss.parameters() if weight.grad is not None]
    assert len(grads) == len(list(loss.parameters()))
    return (
        losses,
        grads,
        torch.stack([loss.gain_scale.sum(), torch.tensor(float(len(loss.slices())))]),
    )


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("per_part", [1, 7, 24])
def test_losses_and_gradients_do_not_depend_on_the_parts(form: str, per_part: int) -> None:
    world = far_world()
    one, whole, scale = gradients(world, form, 2, 10**6)
    few, parts, same = gradients(world, form, 2, per_part * 3 * 25)
    assert (scale[1], same[1]) == (1, -(-25 // per_part))
    assert one.keys() == few.keys()
    for name, loss in one.items():
        torch.testing.assert_close(few[name], loss)
    for ours, theirs in zip(parts, whole, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(same[0], scale[0])


def test_parts_of_footprints_are_the_whole() -> None:
    places = np.stack(np.divmod(np.arange(0, 25, 2), 5), axis=1)
    world = replace(far_world(), cost=np.linspace(0.1, 0.5, 13), coverage=discs((5, 5), places, 1))
    one, whole, scale = gradients(world, "decision", 1, 10**6)
    few, parts, same = gradients(
        world, "decision", 1, 2 * 3 * 25 * 4
    )  # at most four sensors see a cell
    assert (scale[1], same[1]) == (1, 13)
    for name, loss in one.items():
        torch.testing.assert_close(few[name], loss)
    for ours, theirs in zip(parts, whole, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-5)


def test_cells_that_share_weights_may_come_in_different_parts() -> None:
    _, whole, _ = gradients(alike_world(), "decision", 1, 10**6, share_cells=True)
    _, parts, shape = gradients(alike_world(), "decision", 1, 10 * 9, share_cells=True)
    assert shape[1] == 9
    for ours, theirs in zip(parts, whole, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-5)


def test_no_table_of_a_part_has_more_entries_than_allowed() -> None:
    """The largest tensor that autograd keeps, and one cell's entries where the limit is below those."""
    world, largest = far_world(), 0

    def packed(tensor: Tensor) -> Tensor:
        nonlocal largest
        largest = max(largest, tensor.numel())
        return tensor

    for limit, expected in ((10**6, 25 * 3 * 25), (ENTRIES, ENTRIES), (1, 3 * 25)):
        largest = 0
        with torch.autograd.graph.saved_tensors_hooks(packed, lambda tensor: tensor):
            gradients(replace(world, t_max=2), "decision", 2, limit)
        assert largest == max(expected, 25 * 4 * 2)  # the nets' hidden units are not in parts


def test_the_learner_goes_by_its_setting() -> None:
    world = far_world()
    learner = algorithm("hindsight", world, f"algo.max_entries={ENTRIES}", "algo.hidden=4")
    assert len(learner._make_learner(2).loss.slices()) == 5
