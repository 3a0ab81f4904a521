"""The encoder against an ordinary linear layer on explicit one-hots."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.nn.functional import one_hot

from tests.helpers import headings, random_state, small_world
from trackmdp.policies.encoder import RelativeBias, StateEncoder, StateNetwork
from trackmdp.sensing.task import Task
from trackmdp.world.model import World


def features(world: World, cell: Tensor, n: Tensor, history: Tensor) -> Tensor:
    """`[B, K]`: cell, n, both, and the history's bits, each as 0 or 1."""
    m, stages = world.num_cells, world.t_max + 2
    parts = [
        one_hot(cell, m),
        one_hot(n, stages),
        one_hot(cell * stages + n, m * stages),
        history.flatten(1),
    ]
    return torch.cat(parts, dim=1).double()


@pytest.mark.parametrize("t_max", [0, 2])
def test_it_is_a_linear_layer_on_one_hots(t_max: int) -> None:
    world = small_world(t_max=t_max)
    torch.manual_seed(0)
    encoder = StateEncoder(world.task, 8).double()
    with torch.no_grad():
        encoder.history.bias.normal_()
    rows = random_state(world, 60, seed=1)
    inputs = [rows[key] for key in ("last_cell", "steps_since_detection", "action_history")]
    weight = torch.cat([encoder.table.T, encoder.history.weight], dim=1).detach().requires_grad_()
    bias = encoder.history.bias.detach().clone().requires_grad_()
    dense = torch.relu(features(world, *inputs) @ weight.T + bias)
    ours = encoder(*inputs)
    torch.testing.assert_close(ours, dense)
    probe = torch.randn(60, 8, dtype=torch.float64)
    (ours * probe).sum().backward()
    (dense * probe).sum().backward()
    assert encoder.table.grad is not None
    gradients = [encoder.table.grad.T, encoder.history.weight.grad]
    torch.testing.assert_close(torch.cat(gradients, dim=1), weight.grad)
    torch.testing.assert_close(encoder.history.bias.grad, bias.grad)


@pytest.mark.parametrize("known", [{"revealed": 8}, {"memory": "displacement"}])
def test_a_key_adds_what_it_shares_and_its_own(known: dict[str, Any]) -> None:
    """A class of keys moves the features of its keys alone, at its n alone; one key's own weights those of that key."""
    world = headings(**known)
    torch.manual_seed(0)
    encoder, bias = StateEncoder(world.task, 8).double(), RelativeBias(world.task).double()
    keys, classes = torch.arange(world.num_keys), world.keys.num_classes
    state = (
        world.keys.cell(keys),
        torch.ones_like(keys),
        torch.zeros(len(keys), 2, 9, dtype=torch.bool),
        keys,
    )
    before = encoder(*state)
    known = encoder.state_dict()  # views of the table
    for name, row, moved in (
        ("known.0", 5, keys % classes == 5),
        ("known.1", 4 * classes + 5, keys == 4 * classes + 5),
    ):
        with torch.no_grad():
            known[name][row * encoder.stages + 1] += 100.0
        after = encoder(*state)
        assert torch.equal((after != before).any(-1), moved)
        before = after
    with torch.no_grad():
        bias.table[5 * encoder.stages + 1] = 1.0
    assert torch.equal(bias(state[0], state[1], keys).all(-1), keys % classes == 5)
    assert not bias(state[0], state[1] + 1, keys).any()


def test_a_state_dict_names_the_parts_and_is_loaded_again() -> None:
    encoder, other = (StateEncoder(small_world(t_max=1).task, 8) for _ in range(2))
    saved = encoder.state_dict()
    shapes = {name: list(part.shape) for name, part in saved.items()}
    assert shapes == {
        "cell": [9, 8],
        "stage": [3, 8],
        "cell_and_stage": [27, 8],
        "history.weight": [8, 18],
        "history.bias": [8],
    }
    assert torch.equal(saved["stage"], encoder.table[9:12])
    assert other.load_state_dict(saved) == ([], [])
    assert torch.equal(other.table, encoder.table)
    with pytest.raises(RuntimeError, match=r'Missing key.*"table"'):
        other.load_state_dict({name: part for name, part in saved.items() if name != "stage"})


def test_batches_of_any_shape_and_rows_alone() -> None:
    world = small_world(t_max=1)
    torch.manual_seed(0)
    network = StateNetwork(world.task, 8, nn.Linear(8, 3)).double()
    rows = random_state(world, 12, seed=2)
    inputs = [rows[key] for key in ("last_cell", "steps_since_detection", "action_history")]
    flat = network(*inputs)
    assert flat.shape == (12, 3)
    torch.testing.assert_close(
        network(*(x.reshape(3, 4, *x.shape[1:]) for x in inputs)), flat.reshape(3, 4, 3)
    )
    for row in range(12):
        torch.testing.assert_close(network(*(x[row] for x in inputs)), flat[row])
        torch.testing.assert_close(
            network(*(x[row : row + 1] for x in inputs)), flat[row : row + 1]
        )


def test_every_state_has_features_of_its_own() -> None:
    world = small_world(t_max=1)
    torch.manual_seed(0)
    encoder = StateEncoder(world.task, 64)
    cell, n = torch.cartesian_prod(torch.arange(9), torch.arange(3)).unbind(-1)
    seen = encoder(cell, n, torch.zeros(27, 2, 9, dtype=torch.bool)).detach()
    distance = torch.cdist(seen, seen) + torch.eye(27)
    assert distance.min() > 1e-3


def test_the_relative_bias_is_shared_by_all_cells_and_ends_at_the_border() -> None:
    world = small_world(size=3, t_max=1)
    bias = RelativeBias(world.task)
    right = 2 * 5 + 3  # no row further, one column further, in a table of 5 x 5 displacements
    with torch.no_grad():
        bias.table[1, right] = 2.0
    at = bias(torch.arange(9), torch.ones(9, dtype=torch.int64))
    expected = torch.zeros(9, 9)
    for cell, neighbour in ((0, 1), (1, 2), (3, 4), (4, 5), (6, 7), (7, 8)):
        expected[cell, neighbour] = 2.0
    torch.testing.assert_close(at, expected, rtol=0, atol=0)
    assert not bias(torch.arange(9), torch.zeros(9, dtype=torch.int64)).any()
    assert bias(torch.tensor([[0, 4]]), torch.tensor([[1, 1]])).shape == (1, 2, 9)
    at.sum().backward()
    assert bias.table.grad is not None
    assert bias.table.grad[1, right] == 6  # the pairs of cells that are so placed


def test_the_relative_bias_of_a_large_grid_is_that_of_a_small_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Places worked out state by state, without a table of all pairs of cells."""
    task = Task((3, 5), cost=0.2, t_max=1)
    kept = RelativeBias(task)
    monkeypatch.setattr("trackmdp.policies.encoder._PAIRS", 15 * 15 - 1)
    computed = RelativeBias(task)
    assert max(part.numel() for part in computed.buffers()) == 15
    cell, n = torch.cartesian_prod(torch.arange(15), torch.arange(3)).view(5, 9, 2).unbind(-1)
    values, probe = torch.randn(3, 5 * 9), torch.randn(5, 9, 15)
    for bias in (kept, computed):
        with torch.no_grad():
            bias.table.copy_(values)
        (bias(cell, n) * probe).sum().backward()
    assert torch.equal(computed(cell, n), kept(cell, n))
    torch.testing.assert_close(computed.table.grad, kept.table.grad)


def test_the_relative_bias_of_a_window_is_one_number_per_sensor() -> None:
    bias = RelativeBias(Task((3, 5), cost=0.2, t_max=1, window=2))
    assert bias.table.shape == (3, 25)
    assert not list(bias.buffers())
    with torch.no_grad():
        bias.table[1, 13] = 2.0  # one column to the right of the middle, 12
    seen = bias(torch.tensor([[0, 7], [14, 3]]), torch.tensor([[1, 1], [1, 0]]))
    expected = torch.zeros(2, 2, 25)
    expected[[0, 0, 1], [0, 1, 0], 13] = 2.0
    assert torch.equal(seen, expected)
