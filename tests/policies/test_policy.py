"""The one policy: what it says of each state, how it acts, and what becomes one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import sparse
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import ProbabilisticActor

from tests.helpers import ALGORITHMS, algorithm, random_state, small_world
from trackmdp.episodes.simulate import simulate
from trackmdp.errors import UserError
from trackmdp.policies import lookup
from trackmdp.policies.actor_critic import SubsetDistribution
from trackmdp.policies.forms import STATE_KEYS
from trackmdp.policies.policy import Policy, as_policy
from trackmdp.solvers.evaluate import evaluate
from trackmdp.training.group_run import learned_policy

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
    assert acting.as_lists()["sets"]["1"] == [[2], [3], [7]]


@pytest.mark.parametrize("dense_up_to", [0, lookup.DENSE])
def test_both_ways_of_looking_up_agree_with_the_table(
    dense_up_to: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lookup, "DENSE", dense_up_to)
    for on in (table(), table().astype(float) * 0.25):
        acting = Policy.from_dense(WORLD, on)
        state = random_state(WORLD, 60, seed=1).reshape(12, 5)
        seen = acting.probabilities(state["last_cell"], state["steps_since_detection"])
        n = state["steps_since_detection"].clamp_max(WORLD.t_max)
        assert seen.shape == (12, 5, M)
        assert (seen.numpy() == on[state["last_cell"].numpy(), n.numpy()]).all()


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


def test_a_sparse_table_is_brought_into_order_and_left_alone() -> None:
    on = table()
    ordered = sparse.csr_array(on.reshape(-1, M).astype(np.int8))
    indices = ordered.indices.copy()
    for begin, end in zip(ordered.indptr[:-1], ordered.indptr[1:], strict=True):
        indices[begin:end] = indices[begin:end][::-1]
    jumbled = sparse.csr_array((ordered.data, indices.copy(), ordered.indptr), shape=ordered.shape)
    made = Policy(WORLD, jumbled)
    assert made.sets.dtype == np.bool_
    assert (made.sets.indices == ordered.indices).all()
    assert (made.dense() == on).all()
    assert (jumbled.indices == indices).all()


def test_an_actor_that_is_a_policy_is_not_written_out() -> None:
    """All sensors on at 64 x 64 cells would be 33 million entries, 1.5 GB while they are made and valued."""
    actor = Policy.all_on(WORLD)
    assert learned_policy(WORLD, actor, torch.device("cpu")) is actor
    assert actor.alike
