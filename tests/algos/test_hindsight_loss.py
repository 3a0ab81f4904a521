"""The losses, against the formulas written out one path at a time."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from tests.algos.hindsight import FORMS, total
from tests.helpers import small_world
from trackmdp.algos.actor_loss import Decision, decision_loss
from trackmdp.algos.hindsight_loss import HindsightLoss
from trackmdp.algos.path_replay import Replay
from trackmdp.sensing.coverage import discs
from trackmdp.sensing.task import Task
from trackmdp.world.model import World


@given(st.floats(-5, 5), st.floats(0, 3), st.floats(0, 3), st.floats(0.01, 2))
def test_decision_loss_is_least_where_sensing_pays(
    logit: float, plus: float, minus: float, price: float
) -> None:
    """Its slope is (c + G⁻ + G⁺)σ(z) - G⁺, zero at z = log(G⁺ / (c + G⁻))."""
    z = torch.tensor(logit, dtype=torch.float64, requires_grad=True)
    parts = [torch.tensor(part, dtype=torch.float64) for part in (plus, minus, price)]
    decision_loss(z, *parts).backward()
    assert z.grad is not None
    assert z.grad.item() == pytest.approx(
        (price + minus + plus) * torch.sigmoid(z).item() - plus, abs=1e-9
    )


def test_decision_loss_stops_pulling_at_large_logits() -> None:
    logits = torch.tensor([-30.0, 30.0], requires_grad=True)
    decision_loss(logits, torch.ones(2), torch.zeros(2), torch.ones(2)).sum().backward()
    assert logits.grad is not None
    assert logits.grad.tolist() == [0.0, 0.0]


def of_one_path(
    form: str, z: Tensor, cost: Tensor, covers: Tensor, gain: Tensor, on: Tensor
) -> Tensor:
    """The loss of one path at one clock, which it reaches unlocated and leaves for a cell that the sensors `covers` do.

    What seeing it there gains is the gain of each sensor that sees it while none of the others does; `on` says with
    what probability they are on.
    """
    softplus = torch.nn.functional.softplus
    missed = [(1 - on * covers)[torch.arange(len(z)) != s].prod() for s in range(len(z))]
    one = covers * torch.stack(missed)
    if form == "decision":
        plus, minus = gain.clamp(min=0), (-gain).clamp(min=0)
        return (cost * softplus(z) + one * (plus * softplus(-z) + minus * softplus(z))).sum()
    if form == "poisson":
        return (cost * z.exp()).sum() - gain * (one * z).sum()
    on = z.sigmoid()  # the surrogate has the same slope where the old policy is this one
    entropy = -(on * on.log() + (1 - on) * (1 - on).log())
    return (-on * (one * gain - cost) - 0.3 * entropy).sum()


def written_out(
    loss: HindsightLoss, world: Task, cells: Tensor, on: Tensor, blend: float, form: str
) -> dict[str, Tensor]:
    """The losses one path, clock and sensor at a time, as the theory writes them (whole grid, no normalisation)."""
    m, last, g = world.num_keys, world.num_choices, loss.credit.discount
    cost, safe = world.cost / world.reward, 1.0 - world.safe_cost / world.reward
    price = torch.as_tensor(cost, dtype=torch.float32)
    covers = torch.as_tensor(world.covered(np.eye(world.total_sensors, dtype=bool)))  # [S, cells]
    covers = covers.repeat_interleave(world.keys.num_classes, dim=1)
    actor, clocked_actor = loss.actor(), loss.clocked_actor()
    value = [*loss.critic().flatten(), torch.tensor(0.0)]
    clocked = [*loss.clocked_critic().squeeze(-1), torch.zeros(last + 1)]
    u = [
        [clocked[x][n] + (safe if n == last and x < m else 0.0) for n in range(last + 1)]
        for x in range(m + 1)
    ]

    def follow(path: list[int], n: int) -> Tensor:
        """G_n: the return of the chain from step n on."""
        y = path[n + 1]
        if y == m:
            return torch.tensor(0.0)
        if n == last:
            return safe + g * value[y].detach()
        chosen = on[path[0], n]
        after = (
            1.0 + g * value[y].detach()
            if (chosen & covers[:, y]).any()
            else g * follow(path, n + 1)
        )
        return after - float((chosen.numpy() * cost).sum())

    total = {
        name: torch.tensor(0.0) for name in ("actor", "critic", "clocked_actor", "clocked_critic")
    }
    for path in cells.T.tolist():
        x, y = path[:2]
        target = follow(path, 0)
        total["critic"] = total["critic"] + (value[x] - target).square()
        for n in range(last + 1):
            if y == m:
                aim = torch.tensor(0.0)
            elif n == last:
                aim = safe + g * u[y][0]
            else:
                chosen = clocked_actor[x, n] > 0
                aim = 1.0 + g * u[y][0] if (chosen & covers[:, y]).any() else g * u[y][n + 1]
                aim = aim - float((chosen.numpy() * cost).sum())
                gain = 1.0 + g * (u[y][0] - u[y][n + 1]).detach()
                total["clocked_actor"] = total["clocked_actor"] + of_one_path(
                    "decision", clocked_actor[x, n], price, covers[:, y], gain, chosen.float()
                )
            total["clocked_critic"] = total["clocked_critic"] + (u[x][n] - aim.detach()).square()
        for n in range(last):
            y = path[n + 1]
            if y == m:
                break
            trust = (1 - blend) * (u[y][0] - u[y][n + 1]) + blend * (value[y] - follow(path, n + 1))
            gain = (1.0 + g * trust).detach()
            # halfway through a run, sets have cooled down to .05^½
            drawn = (
                actor[x, n].detach() / (0.05**0.5 if form in ("decision", "poisson") else 1.0)
            ).sigmoid()
            total["actor"] = total["actor"] + of_one_path(
                form, actor[x, n], price, covers[:, y], gain, drawn
            )
            if (on[x, n] & covers[:, y]).any():
                break
    return total


SETTINGS = [("decision", t_max, blend) for t_max in (0, 2) for blend in (0.0, 1.0)]


@pytest.mark.parametrize("kind", ["one each", "footprints", "modes told", "displacement"])
@pytest.mark.parametrize(
    ("form", "t_max", "blend"), [*SETTINGS, *((form, 2, 0.6) for form in FORMS)]
)
def test_summed_up_losses_are_those_of_every_path_apart(
    form: str, t_max: int, blend: float, kind: str
) -> None:
    """Gradients agree with autograd through the formulas; clocks are weighed apart, so each is compared by direction.

    Targets do not carry the constant part of a squared error, hence gradients and not values.
    """
    coverage = (
        discs((3, 3), np.array([(0, 0), (0, 1), (1, 0), (1, 2), (2, 1)]), 1)
        if kind == "footprints"
        else None
    )
    count = 9 if coverage is None else 5
    world = replace(
        small_world(t_max=t_max), cost=np.linspace(0.1, 0.5, count), reward=2.0, coverage=coverage
    ).task
    world = replace(world, revealed=2) if kind == "modes told" else world
    world = replace(world, memory="displacement", clip=1) if kind == "displacement" else world
    outside = world.num_keys
    rng = torch.Generator().manual_seed(1)
    loss = HindsightLoss(world.task, FORMS[form](), reach=2, hidden=6, discount=0.7, generator=rng)
    cells = torch.randint(outside + 1, (t_max + 3, 30), generator=rng)
    cells[0] %= outside
    for weights in loss.actor.parameters():  # no logit is so large that losses pull it back
        weights.data *= 0.9
    if world.order:  # each key follows from the one before
        for before, after in pairwise(cells):
            known = world.keys.next(before, 0, world.keys.cell(after))
            after[:] = torch.where(after < outside, known.clamp_max(outside - 1), outside)
    cells = torch.where((cells == outside).cummax(0).values, outside, cells)
    on = torch.rand(outside, t_max + 1, count, generator=rng) < 0.3
    if coverage is not None:  # some sensors on, so that others see no more than these do
        loss.actor.bias.data += torch.tensor([2.0, 0.0, 1.5, 0.0, 2.0])
        loss.clocked_actor.bias.data += torch.tensor([0.0, 2.0, 0.0, 2.0, 1.5])
    loss.actor_loss.prepare(0, 0.5)
    summed, apart = total(loss, cells, on, blend), written_out(loss, world, cells, on, blend, form)
    for name in ("critic", "clocked_critic"):
        ours, theirs = (gradient(part[name], getattr(loss, name)) for part in (summed, apart))
        torch.testing.assert_close(ours * cells.shape[1], theirs, rtol=1e-3, atol=1e-3)
    for name in ("actor", "clocked_actor"):
        ours, theirs = (rows(part[name], getattr(loss, name)) for part in (summed, apart))
        for n in range(t_max + 1):
            ratio = ours[:, n].norm() / theirs[:, n].norm()
            torch.testing.assert_close(ours[:, n], theirs[:, n] * ratio, rtol=1e-3, atol=1e-6)


def test_paths_that_all_end_before_a_detection_lose_nothing() -> None:
    """As of short recordings, in a small batch."""
    task = replace(small_world().task, markov=False)
    rng = torch.Generator().manual_seed(1)
    loss = HindsightLoss(task, Decision(), reach=1, hidden=4, discount=0.8, generator=rng)
    cells = torch.full((Replay.steps(task.keys) + 1, 1), 9)
    cells[0] = 0
    rng.manual_seed(1)  # whose first draw, .76, keeps no path from its first cell on
    losses = total(loss, cells, torch.zeros(9, task.num_choices, 9, dtype=torch.bool), 1.0)
    assert {each.item() for each in losses.values()} == {0.0}


def gradient(loss: Tensor, net: torch.nn.Module) -> Tensor:
    parts = torch.autograd.grad(loss, list(net.parameters()), retain_graph=True)
    return torch.cat([part.flatten() for part in parts])


def rows(loss: Tensor, net: Any) -> Tensor:
    """`[M, C, hidden]` gradient of every row, through the embedding that belongs to it alone."""
    return torch.autograd.grad(loss, net.pair, retain_graph=True)[0]


def test_what_to_sense_is_shared_only_where_it_can_be() -> None:
    large, small = small_world(6, t_max=0), small_world(3, t_max=0)

    def shares(world: World) -> bool:
        rng = torch.Generator().manual_seed(0)
        loss = HindsightLoss(
            world.task,
            Decision(),
            reach=1,
            hidden=4,
            discount=0.8,
            generator=rng,
            classes=np.zeros(world.num_cells, dtype=int),
        )
        assert loss.critic.groups is loss.clocked_critic.groups is None
        return loss.actor.groups is not None and loss.clocked_actor.groups is not None

    assert shares(large)
    assert not shares(small)  # its outputs stand for cells
