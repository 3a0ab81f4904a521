"""Policies in a window of sensors: in its numbers, however they are looked up."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from tests.helpers import random_kernel
from tests.policies.test_policy import M, stochastic
from trackmdp.episodes.simulate import simulate
from trackmdp.errors import UserError
from trackmdp.policies import lookup
from trackmdp.policies.policy import Policy, as_policy
from trackmdp.sensing.task import Task
from trackmdp.solvers.evaluate import evaluate
from trackmdp.world.model import World


def test_in_a_window_a_mixture_is_over_its_sensors() -> None:
    world = windowed()
    made = as_policy(world, stochastic(reads_history=False, width=9))
    # Around cell 0 the local sensors 4, 5, 7 and 8 are the cells 0, 1, 4 and 5; the others lie outside the grid.
    expected = torch.zeros(12)
    expected[[0, 1, 4, 5]] = torch.sigmoid((1 + torch.tensor([4.0, 5, 7, 8])) / 4 - 2)
    assert torch.allclose(made.probabilities(torch.tensor([0]), torch.tensor([1]))[0], expected)


def windowed() -> World:
    return World(
        random_kernel(np.random.default_rng(0), 12, 0.1), (3, 4), cost=0.2, t_max=2, window=1
    )


def test_all_on_is_all_of_the_window() -> None:
    world = windowed()
    made = Policy.all_on(world)
    assert made.deterministic
    assert made.as_lists()["sets"]["0"] == [[0, 1, 4, 5]] * 3
    assert made.as_lists()["sets"]["6"] == [[1, 2, 3, 5, 6, 7, 9, 10, 11]] * 3
    state = {"last_cell": torch.tensor([0, 6]), "steps_since_detection": torch.tensor([0, 3])}
    action = made(TensorDict(state, [2]))["action"]
    assert [on.nonzero().flatten().tolist() for on in action] == [[4, 5, 7, 8], list(range(9))]
    assert made.spent(1, world.cost) == pytest.approx(0.2 * made.dense()[:, 1].sum(1))
    assert not Policy.none(world)(TensorDict(state, [2]))["action"].any()


@pytest.mark.parametrize("dense_up_to", [0, lookup.DENSE])
def test_in_a_window_policies_act_and_are_asked_in_its_numbers(
    dense_up_to: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lookup, "DENSE", dense_up_to)
    monkeypatch.setattr("trackmdp.policies.unroll._HISTORY_AT_ONCE", 5 * 3 * 9)
    world = windowed()
    near = Policy.all_on(world).dense()
    table = near & (np.random.default_rng(0).random(near.shape) < 0.5)
    acting = Policy.from_dense(world, table)
    asked = TensorDictModule(
        lambda x, n, h: (
            acting(TensorDict({"last_cell": x, "steps_since_detection": n}, [len(x)]))["action"]
            | h.new_ones(len(x), 1) & (torch.arange(9) == 0)
        ),
        in_keys=["last_cell", "steps_since_detection", "action_history"],
        out_keys=["action"],
    )
    read = as_policy(world, asked).dense()
    upper_left = np.zeros_like(near)
    for x in range(12):
        if x >= 5 and x % 4:
            upper_left[x, :, x - 5] = True
    assert (read == table | upper_left).all()


def test_random_k_of_a_window() -> None:
    world = windowed()
    drawing = Policy.random_k(world, 5)
    assert drawing.chosen(0, np.array([0, 6, 0]), np.array([5, 1, 2])) == pytest.approx(
        [1.0, 5 / 9, 0.0]
    )
    torch.manual_seed(0)
    state = {
        "last_cell": torch.tensor([0, 6]).repeat(500),
        "steps_since_detection": torch.zeros(1000, dtype=torch.int64),
    }
    action = drawing(TensorDict(state, [1000]))["action"]
    assert action.shape == (1000, 9)
    assert action.sum(1).tolist() == [4, 5] * 500
    assert action[1::2].double().mean(0) == pytest.approx(np.full(9, 5 / 9), abs=5 * 0.5 / 500**0.5)


def test_random_k_of_the_sensors_that_exist() -> None:
    cost = np.where(np.arange(M) < 4, 0.1, np.nan)
    drawing = Policy.random_k(Task((3, 3), cost=cost, t_max=1), 3)
    share = np.where(np.arange(M) < 4, 3 / 4, 0.0)
    assert drawing.chosen(0, np.zeros(M, dtype=int), np.arange(M)) == pytest.approx(share)
    state = {"last_cell": torch.zeros(50, dtype=torch.int64)}
    state["steps_since_detection"] = state["last_cell"]
    action = drawing(TensorDict(state, [50]))["action"]
    assert action.sum(1).tolist() == [3] * 50
    assert not action[:, 4:].any()


@pytest.mark.parametrize("at_once", [1, 3, 4, 100])
@pytest.mark.parametrize(("cell", "n", "sensor"), [(0, 2, 2), (3, 0, 5), (11, 2, 0)])
def test_a_sensor_outside_the_window_is_refused(
    cell: int, n: int, sensor: int, at_once: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Among sensors that can be chosen, wherever it is, and however many are checked at once."""
    monkeypatch.setattr("trackmdp.policies.table._AT_ONCE", at_once)
    on = np.zeros((12, 3, 12), dtype=bool)
    on[::2, 1] = np.eye(12, dtype=bool)[::2]
    Policy.from_dense(windowed(), on)
    on[cell, n, sensor] = True
    with pytest.raises(
        UserError, match=rf"sensor {sensor} cannot be chosen from cell {cell}, with grid\.window=1"
    ):
        Policy.from_dense(windowed(), on)


@pytest.mark.parametrize("t_max", [0, 2])
def test_every_sensor_of_a_window_is_on_however_it_is_looked_up(t_max: int) -> None:
    world = World(
        random_kernel(np.random.default_rng(0), 20, 0.1), (4, 5), cost=0.1, t_max=t_max, window=1
    )
    everything = Policy.all_on(world)
    cell = torch.arange(20).repeat_interleave(t_max + 2).view(2, -1)
    state = TensorDict(
        {
            "last_cell": cell,
            "steps_since_detection": torch.arange(t_max + 2).repeat(20).view(2, -1),
        },
        [2],
    )
    assert torch.equal(
        everything(state.clone())["action"], Policy(world, everything.sets)(state.clone())["action"]
    )
    assert (everything.sets.dtype, everything.sets.indices.dtype) == (np.bool_, np.int32)


@pytest.mark.parametrize("footprints", [False, True])
@pytest.mark.parametrize("kind", ["all on", "table", "wider", "keys"])
def test_a_policy_of_a_wider_choice_is_refused_in_a_window(kind: str, footprints: bool) -> None:
    """A row of 5 cells: with a window of 1 sensor 2 cannot be chosen from cell 0; with a pair of cells each, sensor 2
    sees cells 2 and 3."""
    more = {"coverage": np.eye(5) + np.eye(5, k=1)} if footprints else {}
    world = World(np.full((5, 5), 0.18), (1, 5), cost=0.1, t_max=0, window=1, **more)
    wide = world.but(
        window=2 if kind == "wider" else None, memory="displacement" if kind == "keys" else "cell"
    )
    policy = Policy.all_on(wide)
    if kind in ("table", "keys"):
        policy = Policy(wide, policy.written)
    for call in (evaluate, lambda *given: simulate(*given, 1)):
        with pytest.raises(
            UserError, match=r"^policy: sensor 2 cannot be chosen from cell 0, with grid\.window=1$"
        ):
            call(world, policy)
    near = Policy.from_dense(wide, Policy.all_on(world.but(memory=wide.memory)).dense())
    assert evaluate(world, near).aihtr == pytest.approx(evaluate(world, "all_on").aihtr)
