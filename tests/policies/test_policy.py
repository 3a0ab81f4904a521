"""The one policy: what it says of each state, how it acts, and what becomes one."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy import sparse
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import ProbabilisticActor

from tests.helpers import ALGORITHMS, algorithm, random_kernel, random_state, small_world
from trackmdp.episodes.simulate import simulate
from trackmdp.errors import UserError
from trackmdp.policies import lookup, policy
from trackmdp.policies.forms import STATE_KEYS
from trackmdp.policies.nets import SubsetDistribution
from trackmdp.policies.policy import Policy, as_policy
from trackmdp.sensing.task import Task
from trackmdp.solvers.evaluate import evaluate
from trackmdp.training.group_run import learned_policy
from trackmdp.world.model import World

WORLD = small_world(t_max=2)
M, CHOICES = WORLD.num_cells, WORLD.num_choices


def table(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random((M, CHOICES, M)) < 0.4


def everywhere() -> tuple[np.ndarray, np.ndarray]:
    """Every pair of a located cell and a sensor."""
    rows, cells = np.divmod(np.arange(M * M), M)
    return rows, cells


def three_by_history(
    last_cell: torch.Tensor, n: torch.Tensor, history: torch.Tensor
) -> torch.Tensor:
    """Senses its own cell, and later the cells after those it has sensed."""
    own = torch.nn.functional.one_hot(last_cell, M).bool()
    return own | history.any(1).roll(1, -1)


def test_a_table_is_looked_up_by_cell_and_misses() -> None:
    on = np.zeros((M, CHOICES, M), dtype=bool)
    on[1, 0, 2] = on[1, 1, 3] = on[2, 1, 0] = on[1, 2, 7] = True
    acting = Policy.from_dense(WORLD, on)
    rows = {
        "last_cell": torch.tensor([1, 1, 2, 0, 1]),
        "steps_since_detection": torch.tensor([0, 1, 1, 1, 3]),
    }
    action = acting(TensorDict(rows, [5]))["action"]
    assert [cells.nonzero().flatten().tolist() for cells in action] == [[2], [3], [0], [], [7]]
    assert action.dtype == torch.bool
    assert acting.deterministic
    assert acting.num_draws == 0
    assert acting.as_lists()["sets"]["1"] == [[2], [3], [7]]


@pytest.mark.parametrize("dense_up_to", [0, policy._DENSE])
def test_both_ways_of_looking_up_agree_with_the_table(
    dense_up_to: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(policy, "_DENSE", dense_up_to)
    for on in (table(), table().astype(float) * 0.25):
        acting = Policy.from_dense(WORLD, on)
        state = random_state(WORLD, 60, seed=1).reshape(12, 5)
        seen = acting.probabilities(state["last_cell"], state["steps_since_detection"])
        n = state["steps_since_detection"].clamp_max(WORLD.t_max)
        assert seen.shape == (12, 5, M)
        assert (seen.numpy() == on[state["last_cell"].numpy(), n.numpy()]).all()
        form = lookup.SparseTable if dense_up_to == 0 else lookup.DenseTable
        assert isinstance(acting.lookup(torch.device("cpu")), form)


@pytest.mark.parametrize(
    "on", [table(), table() * np.random.default_rng(1).random((M, CHOICES, M))]
)
def test_exact_evaluation_reads_the_table(on: np.ndarray) -> None:
    read, (rows, cells) = Policy.from_dense(WORLD, on), everywhere()
    price = np.random.default_rng(2).random(M)
    for n in range(CHOICES):
        assert (read.chosen(n, rows, cells).reshape(M, M) == on[:, n]).all()
        assert read.spent(n, price) == pytest.approx(on[:, n] @ price, abs=1e-12)


def test_an_empty_table_is_no_sensor_anywhere() -> None:
    read, (rows, cells) = (
        Policy.from_dense(WORLD, np.zeros((M, CHOICES, M), dtype=bool)),
        everywhere(),
    )
    assert not read.chosen(0, rows, cells).any()
    assert not read.spent(1, WORLD.cost).any()
    assert not read(random_state(WORLD, 5, seed=0))["action"].any()


@pytest.mark.parametrize(
    ("made", "share"), [(Policy.all_on(WORLD), 1.0), (Policy.none(WORLD), 0.0)]
)
def test_all_on_and_none(made: Policy, share: float) -> None:
    rows, cells = everywhere()
    assert made.deterministic
    assert (made.chosen(1, rows, cells) == share).all()
    assert made.spent(0, WORLD.cost) == pytest.approx(np.full(M, share * WORLD.cost.sum()))
    assert made(random_state(WORLD, 5, seed=0))["action"].tolist() == [[share == 1.0] * M] * 5
    assert (made.dense() == share).all()
    assert made.as_lists() == Policy.from_dense(WORLD, made.dense()).as_lists()


@pytest.mark.parametrize("k", [0, 1, 3, 9])
def test_random_k_draws_exactly_k_from_its_own_generator(k: int) -> None:
    state = {"last_cell": torch.zeros(20_000, dtype=torch.int64)}
    state["steps_since_detection"] = state["last_cell"]
    before, actions = torch.get_rng_state(), []
    for _ in range(2):
        drawing = Policy.random_k(WORLD, k)
        drawing.generator = torch.Generator().manual_seed(0)
        actions.append(drawing(TensorDict(state, [20_000]))["action"].clone())
    assert torch.equal(*actions)
    assert torch.equal(torch.get_rng_state(), before)
    assert (actions[0].sum(-1) == k).all()
    share = k / 9
    assert (actions[0].double().mean(0) - share).abs().max() <= 5 * (
        share * (1 - share) / 20_000
    ) ** 0.5
    assert drawing.chosen(0, np.arange(M), np.arange(M)) == pytest.approx(np.full(M, share))
    assert drawing.deterministic == (k in (0, 9))


def test_probabilities_are_those_of_the_sensors_switched_on() -> None:
    chances = np.random.default_rng(3).random((M, CHOICES, M)) * table()
    drawing = Policy.from_dense(WORLD, chances)
    assert not drawing.deterministic
    state = {
        "last_cell": torch.full((20_000,), 4),
        "steps_since_detection": torch.full((20_000,), 1),
    }
    torch.manual_seed(0)
    seen = drawing(TensorDict(state, [20_000]))["action"].double().mean(0).numpy()
    assert seen == pytest.approx(chances[4, 1], abs=5 * 0.5 / 20_000**0.5)
    with pytest.raises(UserError, match="draws its sets"):
        drawing.dense()


def test_a_function_is_followed_along_its_own_history() -> None:
    read = as_policy(WORLD, three_by_history).dense()
    for x in range(M):
        assert read[x].nonzero()[1].tolist() == [
            x,
            *sorted([x, (x + 1) % M]),
            *sorted([x, (x + 1) % M, (x + 2) % M]),
        ]


@pytest.mark.parametrize("at_once", [1, 2 * CHOICES * M, 2**22])
def test_blocks_of_located_cells_change_nothing(
    at_once: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("trackmdp.policies.unroll._HISTORY_AT_ONCE", at_once)
    asked = []

    def counted(last_cell: torch.Tensor, n: torch.Tensor, history: torch.Tensor) -> torch.Tensor:
        asked.append(len(last_cell))
        return three_by_history(last_cell, n, history)

    whole = Policy.from_dense(WORLD, as_policy(WORLD, three_by_history).dense())
    assert (Policy.from_function(WORLD, counted, check=False).sets != whole.sets).nnz == 0
    assert max(asked) * CHOICES * M <= max(at_once, CHOICES * M)
    assert sum(asked) == CHOICES * M


def test_a_function_may_write_to_what_it_is_given() -> None:
    def spoils(last_cell: torch.Tensor, n: torch.Tensor, history: torch.Tensor) -> torch.Tensor:
        action = three_by_history(last_cell, n, history)
        last_cell.zero_(), n.zero_(), history.fill_(True)
        return action

    assert (as_policy(WORLD, spoils).dense() == as_policy(WORLD, three_by_history).dense()).all()


@pytest.mark.parametrize("name", ALGORITHMS)
def test_a_learner_s_actor_becomes_the_table_of_its_modes(name: str) -> None:
    actor = algorithm(name, WORLD).actor
    before = torch.get_rng_state()
    read = Policy.from_module(WORLD, actor)
    assert torch.equal(torch.get_rng_state(), before)
    first = {
        "last_cell": torch.arange(M),
        "steps_since_detection": torch.zeros(M, dtype=torch.int64),
        "action_history": torch.zeros(M, CHOICES, M, dtype=torch.bool),
    }
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        assert torch.equal(
            read(TensorDict(first, [M]))["action"], actor(TensorDict(first, [M]))["action"]
        )


def stochastic(reads_history: bool, width: int = M) -> ProbabilisticActor:
    """Sensor j is on with probability σ((x + n + j) / 4 - 2), and one more where the history holds it."""

    def logits(x: torch.Tensor, n: torch.Tensor, h: torch.Tensor) -> torch.Tensor:
        base = (x[..., None] + n[..., None] + torch.arange(width)) / 4 - 2
        return base + (h.any(-2) if reads_history else 0)

    return ProbabilisticActor(
        TensorDictModule(logits, in_keys=list(STATE_KEYS), out_keys=["logits"]),
        in_keys=["logits"],
        distribution_class=SubsetDistribution,
    )


def test_a_stochastic_actor_is_valued_as_the_mixture_it_is() -> None:
    """By its probabilities exactly, in agreement with 6,000 episodes of its draws; by its mode where that is asked."""
    actor = stochastic(reads_history=False)
    x, n, j = np.ogrid[:M, :CHOICES, :M]
    exact = evaluate(WORLD, Policy.from_dense(WORLD, 1 / (1 + np.exp(2 - (x + n + j) / 4))))
    assert evaluate(WORLD, actor).aihtr == pytest.approx(exact.aihtr, rel=1e-6)
    simulated = simulate(WORLD, actor, 6_000).figures().aihtr
    assert abs(simulated.mean - exact.aihtr) < 4 * simulated.standard_error
    mode = evaluate(WORLD, Policy.from_module(WORLD, actor)).aihtr
    assert mode == pytest.approx(evaluate(WORLD, (x + n + j) / 4 > 2).aihtr)
    assert abs(mode - exact.aihtr) > 0.1
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        assert evaluate(WORLD, actor).aihtr == mode


def test_draws_that_depend_on_draws_before_are_refused_and_can_be_simulated() -> None:
    actor = stochastic(reads_history=True)
    with pytest.raises(
        UserError, match="depend on earlier draws, so it has no exact value; simulate it"
    ) as no:
        evaluate(WORLD, actor)
    assert "\n" not in str(no.value)
    drawn, free = (simulate(WORLD, stochastic(each), 6_000).figures() for each in (True, False))
    assert drawn.sensors_per_step.mean > free.sensors_per_step.mean + 0.05
    assert Policy.from_module(WORLD, actor).deterministic
    once = replace(WORLD, t_max=0)
    assert evaluate(once, actor).aihtr == evaluate(once, stochastic(reads_history=False)).aihtr


def test_a_recurrent_module_keeps_its_state_in_every_episode() -> None:
    """It counts its steps and senses everything at every third; at the first it is given None."""

    def turn(cell: torch.Tensor, count: torch.Tensor | None) -> tuple[torch.Tensor, torch.Tensor]:
        count = torch.zeros_like(cell) if count is None else count
        return (count % 3 == 0).unsqueeze(-1).expand(-1, 9), count + 1

    module = TensorDictModule(
        turn, in_keys=["last_cell", "count"], out_keys=["action", ("next", "count")]
    )
    world = replace(WORLD, t_max=4)  # never forced: of three steps one detects
    with pytest.raises(
        UserError, match="keeps count from step to step, so it has no exact value; simulate it"
    ):
        evaluate(world, module)
    for _ in range(2):
        for episode in simulate(world, module, 40).complete():
            on = episode.action.sum(axis=1)
            assert on.tolist() == [9 if t % 3 == 0 else 0 for t in range(len(on))]


def test_in_a_window_a_mixture_is_over_its_sensors() -> None:
    world = windowed()
    made = as_policy(world, stochastic(reads_history=False, width=9))
    # Around cell 0 the local sensors 4, 5, 7 and 8 are the cells 0, 1, 4 and 5; the others lie outside the grid.
    expected = torch.zeros(12)
    expected[[0, 1, 4, 5]] = torch.sigmoid((1 + torch.tensor([4.0, 5, 7, 8])) / 4 - 2)
    assert torch.allclose(made.probabilities(torch.tensor([0]), torch.tensor([1]))[0], expected)


class Signs(torch.distributions.HalfNormal):
    """Draws subsets, and does not say how likely each is."""

    has_rsample = False

    def sample(self, sample_shape: Any = ()) -> torch.Tensor:
        return super().sample(sample_shape) > 1


SHARED = torch.Generator().manual_seed(0)
DRAWING: dict[str, Any] = {
    "torch": lambda x, n, h: torch.rand(len(x), M) < 0.5,
    "torch, seldom": lambda x, n, h: torch.rand(len(x), M) < 1e-9,
    "its own generator": lambda x, n, h: torch.rand(len(x), M, generator=SHARED) < 0.5,
    "numpy": lambda x, n, h: np.random.random((len(x), M)) < 0.5,  # noqa: NPY002
    "module": TensorDictModule(
        lambda x: torch.rand(*x.shape, M) < 0.5, in_keys=["last_cell"], out_keys=["action"]
    ),
    "an actor of another form": ProbabilisticActor(
        TensorDictModule(
            lambda x: torch.ones(len(x), M), in_keys=["last_cell"], out_keys=["scale"]
        ),
        in_keys=["scale"],
        distribution_class=Signs,
    ),
    "dropout": TensorDictModule(
        lambda x: torch.nn.functional.dropout(torch.ones(*x.shape, M)) > 0,
        in_keys=["last_cell"],
        out_keys=["action"],
    ),
}


@pytest.mark.parametrize("name", DRAWING)
def test_what_draws_is_refused_in_one_line(name: str) -> None:
    with pytest.raises(UserError, match="draws at random") as refused:
        as_policy(WORLD, DRAWING[name])
    assert "\n" not in str(refused.value)


def sequence(key: str) -> TensorDictModule:
    return TensorDictModule(
        lambda x: torch.ones(len(x), M, dtype=torch.bool), in_keys=[key], out_keys=["action"]
    )


WRONG: dict[str, tuple[Any, str]] = {
    "numbers": (
        lambda x, n, h: torch.full((len(x), M), 0.5),
        "its action: expected 0 or 1 for each sensor, got 0.5",
    ),
    "another width": (
        lambda x, n, h: torch.zeros(len(x), M + 1, dtype=torch.bool),
        r"bool \[9, 10\]",
    ),
    "reads more": (sequence("hidden"), "reads hidden"),
    "reads the target": (sequence("target"), "reads target"),
    "no action": (
        TensorDictModule(torch.nn.Identity(), in_keys=["last_cell"], out_keys=["a"]),
        "writes no action",
    ),
    "a number": (3, "a int, expected a Policy"),
    "another world": (
        Policy.all_on(small_world(2, t_max=2)),
        "made for 2 x 2 cells, t_max 2; expected 3 x 3",
    ),
    "as many cells": (Policy.all_on(Task((1, 9), cost=0.1, t_max=2)), "made for 1 x 9 cells"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_no_policy_is_refused_in_one_line(name: str) -> None:
    given, message = WRONG[name]
    with pytest.raises(UserError, match=message):
        as_policy(WORLD, given)


@pytest.mark.parametrize(
    "wrong", [np.zeros((M, CHOICES, M + 1)), np.full((M, CHOICES, M), 1.5), -table().astype(int)]
)
def test_a_table_that_is_none_is_refused(wrong: np.ndarray) -> None:
    with pytest.raises(UserError, match="expected"):
        Policy.from_dense(WORLD, wrong)


def test_a_complex_table_is_refused() -> None:
    for make in (lambda on: Policy.from_dense(WORLD, on), lambda on: evaluate(WORLD, on)):
        with pytest.raises(UserError, match="complex128"):
            make(table() * 1j)


def test_a_sparse_table_is_brought_into_order_and_left_alone() -> None:
    on = table()
    ordered = sparse.csr_array(on.reshape(-1, M).astype(np.int8))
    indices = ordered.indices.copy()
    for begin, end in zip(ordered.indptr[:-1], ordered.indptr[1:], strict=True):
        indices[begin:end] = indices[begin:end][::-1]
    jumbled = sparse.csr_array((ordered.data, indices.copy(), ordered.indptr), shape=ordered.shape)
    made = Policy(WORLD, jumbled)
    assert made.sets is not None
    assert made.sets.dtype == np.bool_
    assert (made.sets.indices == ordered.indices).all()
    assert (made.dense() == on).all()
    assert (jumbled.indices == indices).all()


def test_an_actor_that_is_a_policy_is_not_written_out() -> None:
    """All sensors on at 64 x 64 cells would be 33 million entries, 1.5 GB while they are made and valued."""
    actor = Policy.all_on(WORLD)
    assert learned_policy(WORLD, actor, torch.device("cpu")) is actor
    assert actor.sets is None


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


@pytest.mark.parametrize("dense_up_to", [0, policy._DENSE])
def test_in_a_window_policies_act_and_are_asked_in_its_numbers(
    dense_up_to: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(policy, "_DENSE", dense_up_to)
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
    assert everything.sets is not None
    assert (everything.sets.dtype, everything.sets.indices.dtype) == (np.bool_, np.int32)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("last_cell", -1),
        ("last_cell", M),
        ("steps_since_detection", -1),
        ("steps_since_detection", CHOICES + 1),
    ],
)
@pytest.mark.parametrize(
    "acting",
    [Policy.all_on(WORLD), Policy.from_dense(WORLD, table()), Policy.random_k(WORLD, 2)],
)
def test_a_state_that_is_none_is_refused(acting: Policy, key: str, value: int) -> None:
    rows = {"last_cell": torch.tensor([1, 2]), "steps_since_detection": torch.tensor([0, 1])}
    rows[key][1] = value
    with pytest.raises(UserError, match=f"{key}={value}"):
        acting(TensorDict(rows, [2]))
