from __future__ import annotations

import io
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import Tensor

from tests.helpers import algorithm, collect, hop_world, small_world
from trackmdp.algos.actor_loss import Decision, Poisson, PolicyGradient, Surrogate, decision_loss
from trackmdp.algos.hindsight import _within
from trackmdp.algos.hindsight_loss import HindsightLoss
from trackmdp.config import GROUPS, PerSensor, Schedule
from trackmdp.errors import UserError
from trackmdp.solvers import bounds, optimal
from trackmdp.solvers.chains import evaluate, regret_per_step
from trackmdp.training.evaluate import chains_of
from trackmdp.world.kernels import random_walk
from trackmdp.world.model import World

SHORT = ("algo.updates=30", "algo.updates_per_iteration=10", "algo.batch_size=512", "algo.hidden=16")
SOLVES = ("algo.updates=300", "algo.updates_per_iteration=100", "algo.batch_size=2048", "algo.hidden=32")


def batches(world: World, count: int = 16, *, envs: int = 32, seed: int = 0) -> list[Any]:
    """What the collector hands over with `tests.helpers.algorithm`'s budget."""
    time = 8 * count
    return list(collect(world, algorithm("hindsight", world).policy, envs, time, seed=seed).split(8, dim=1))


PER_SENSOR = [name for name, schema in GROUPS["algo"].items() if issubclass(schema, PerSensor)]


def learn(world: World, data: list[Any], *overrides: str, name: str = "hindsight") -> Any:
    learner = algorithm(name, world, *overrides)
    for batch in [*data, *[None] * (learner.iterations - len(data))]:
        learner.step(batch)
    return learner


def policy(learner: Any, world: World) -> Any:
    return chains_of(learner.actor, world)


@given(st.floats(-5, 5), st.floats(0, 3), st.floats(0, 3), st.floats(0.01, 2))
def test_decision_loss_is_least_where_sensing_pays(logit: float, plus: float, minus: float, price: float) -> None:
    """Its slope is (c + G⁻ + G⁺)σ(z) - G⁺, zero at z = log(G⁺ / (c + G⁻))."""
    z = torch.tensor(logit, dtype=torch.float64, requires_grad=True)
    parts = [torch.tensor(part, dtype=torch.float64) for part in (plus, minus, price)]
    decision_loss(z, *parts).backward()
    assert z.grad is not None
    assert z.grad.item() == pytest.approx((price + minus + plus) * torch.sigmoid(z).item() - plus, abs=1e-9)


def test_decision_loss_stops_pulling_at_large_logits() -> None:
    logits = torch.tensor([-30.0, 30.0], requires_grad=True)
    decision_loss(logits, torch.ones(2), torch.zeros(2), torch.ones(2)).sum().backward()
    assert logits.grad is not None
    assert logits.grad.tolist() == [0.0, 0.0]


BETA = Schedule(start=0.3, end=0.3, begin=0.0, until=1.0)
FORMS = {
    "decision": Decision,
    "policy gradient": lambda: PolicyGradient(BETA),
    "surrogate": lambda: Surrogate(BETA, clip=0.2, minibatches=1, generator=None),
    "poisson": Poisson,
}


def of_one_path(form: str, z: Tensor, cost: Tensor, y: int, gain: Tensor) -> Tensor:
    """The loss of one path at one clock, which it reaches unlocated and leaves for y: what every sensor adds to it."""
    softplus, one = torch.nn.functional.softplus, torch.nn.functional.one_hot(torch.tensor(y), len(z))
    if form == "decision":
        return (cost * softplus(z)).sum() + gain.clamp(min=0) * softplus(-z[y]) + (-gain).clamp(min=0) * softplus(z[y])
    if form == "poisson":
        return (cost * z.exp()).sum() - gain * z[y]
    on = z.sigmoid()  # the surrogate has the same slope where the old policy is this one
    entropy = -(on * on.log() + (1 - on) * (1 - on).log())
    return (-on * (one * gain - cost) - 0.3 * entropy).sum()


def written_out(
    loss: HindsightLoss, world: World, cells: Tensor, on: Tensor, blend: float, form: str
) -> dict[str, Tensor]:
    """The losses one path, clock and sensor at a time, as the theory writes them (whole grid, no normalisation)."""
    m, last, g = world.num_cells, world.num_choices, loss.discount
    cost, safe = world.cost / world.reward, 1.0 - world.safe_cost / world.reward
    price = torch.as_tensor(cost, dtype=torch.float32)
    actor, clocked_actor = loss.actor(), loss.clocked_actor()
    value = [*loss.critic().flatten(), torch.tensor(0.0)]
    clocked = [*loss.clocked_critic().squeeze(-1), torch.zeros(last + 1)]
    u = [[clocked[x][n] + (safe if n == last and x < m else 0.0) for n in range(last + 1)] for x in range(m + 1)]

    def follow(path: list[int], n: int) -> Tensor:
        """G_n: the return of the chain from step n on."""
        y = path[n + 1]
        if y == m:
            return torch.tensor(0.0)
        if n == last:
            return safe + g * value[y].detach()
        chosen = on[path[0], n]
        after = 1.0 + g * value[y].detach() if chosen[y] else g * follow(path, n + 1)
        return after - float((chosen.numpy() * cost).sum())

    total = {name: torch.tensor(0.0) for name in ("actor", "critic", "clocked_actor", "clocked_critic")}
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
                aim = 1.0 + g * u[y][0] if chosen[y] else g * u[y][n + 1]
                aim = aim - float((chosen.numpy() * cost).sum())
                gain = 1.0 + g * (u[y][0] - u[y][n + 1]).detach()
                total["clocked_actor"] = total["clocked_actor"] + of_one_path(
                    "decision", clocked_actor[x, n], price, y, gain
                )
            total["clocked_critic"] = total["clocked_critic"] + (u[x][n] - aim.detach()).square()
        for n in range(last):
            y = path[n + 1]
            if y == m:
                break
            trust = (1 - blend) * (u[y][0] - u[y][n + 1]) + blend * (value[y] - follow(path, n + 1))
            gain = (1.0 + g * trust).detach()
            total["actor"] = total["actor"] + of_one_path(form, actor[x, n], price, y, gain)
            if on[x, n, y]:
                break
    return total


SETTINGS = [("decision", t_max, blend) for t_max in (0, 1, 2) for blend in (0.0, 0.6, 1.0)]


@pytest.mark.parametrize(("form", "t_max", "blend"), [*SETTINGS, *((form, 2, 0.6) for form in FORMS)])
def test_summed_up_losses_are_those_of_every_path_apart(form: str, t_max: int, blend: float) -> None:
    """Gradients agree with autograd through the formulas; clocks are weighed apart, so each is compared by direction.

    Targets do not carry the constant part of a squared error, hence gradients and not values.
    """
    world = replace(small_world(t_max=t_max), cost=np.linspace(0.1, 0.5, 9), reward=2.0)
    rng = torch.Generator().manual_seed(1)
    loss = HindsightLoss(world.task, FORMS[form](), reach=2, hidden=6, discount=0.7, generator=rng)
    cells = torch.randint(10, (t_max + 3, 60), generator=rng)
    cells[0] %= 9
    cells = torch.where((cells == 9).cummax(0).values, 9, cells)
    on = torch.rand(9, t_max + 1, 9, generator=rng) < 0.3
    summed, apart = loss(cells, on, blend), written_out(loss, world, cells, on, blend, form)
    for name in ("critic", "clocked_critic"):
        ours, theirs = (gradient(part[name], getattr(loss, name)) for part in (summed, apart))
        torch.testing.assert_close(ours * cells.shape[1], theirs, rtol=1e-3, atol=1e-3)
    for name in ("actor", "clocked_actor"):
        ours, theirs = (rows(part[name], getattr(loss, name)) for part in (summed, apart))
        for n in range(t_max + 1):
            ratio = ours[:, n].norm() / theirs[:, n].norm()
            torch.testing.assert_close(ours[:, n], theirs[:, n] * ratio, rtol=1e-3, atol=1e-6)


def gradient(loss: Tensor, net: torch.nn.Module) -> Tensor:
    parts = torch.autograd.grad(loss, list(net.parameters()), retain_graph=True)
    return torch.cat([part.flatten() for part in parts])


def rows(loss: Tensor, net: Any) -> Tensor:
    """`[M, C, hidden]` gradient of every row, through the embedding that belongs to it alone."""
    return torch.autograd.grad(loss, net.pair, retain_graph=True)[0]


VARIANTS = [
    *((name, ()) for name in PER_SENSOR if name != "hindsight"),
    ("ppo_per_sensor", ("algo.surrogate=sampled",)),
]


@pytest.mark.parametrize("t_max", [0, 2])
def test_reaches_the_optimum_of_a_small_world(t_max: int) -> None:
    assert_it_learns("hindsight", (), t_max)


@pytest.mark.slow
@pytest.mark.parametrize("t_max", [0, 2])
@pytest.mark.parametrize(("name", "words"), VARIANTS)
def test_every_actor_loss_reaches_the_optimum_of_a_small_world(name: str, words: tuple[str, ...], t_max: int) -> None:
    assert_it_learns(name, words, t_max)


def assert_it_learns(name: str, words: tuple[str, ...], t_max: int) -> None:
    world = small_world(t_max=t_max, exit_probability=0.02)
    learner = learn(world, batches(world, 32), *SOLVES, "algo.total_frames=8192", *words, name=name)
    best = optimal.solve(world, time_limit=5.0)
    assert regret_per_step(best.upper, evaluate(world, policy(learner, world))) < 0.01


def test_ppo_draws_sets_only_where_it_is_asked_to() -> None:
    world = small_world()
    data = batches(world)
    drawn = [learn(world, data, *SHORT, *words, name="ppo_per_sensor") for words in ((), ("algo.surrogate=sampled",))]
    expected, sampled = (learner._learner.loss.actor.weight for learner in drawn)
    assert not torch.equal(expected, sampled)


@pytest.mark.parametrize("name", PER_SENSOR)
def test_prices_are_per_cell(name: str) -> None:
    """The hopping target is worth sensing in the cheap cells only; r = 2, and a miss costs D in the end."""
    world = replace(hop_world(0, safe_cost=0.1), cost=np.array([0.1, 9.0, 0.1, 9.0]))
    chains = policy(learn(world, batches(world), *SOLVES, name=name), world)
    assert chains[:, 0].astype(int).tolist() == [[0, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 0], [1, 0, 0, 0]]


@pytest.mark.parametrize("name", PER_SENSOR)
def test_the_unit_of_reward_does_not_matter(name: str) -> None:
    world = small_world()
    data = batches(world)
    scaled = replace(world, reward=world.reward * 1024, cost=world.cost * 1024, safe_cost=world.safe_cost * 1024)
    one, other = (policy(learn(each, data, *SHORT, name=name), each) for each in (world, scaled))
    assert np.array_equal(one, other)


@pytest.mark.parametrize("name", PER_SENSOR)
def test_reads_nothing_that_was_not_sensed(name: str) -> None:
    """Positions after steps that did not sense everything, the true cell and the reward may be anything."""
    world = small_world()
    rng = torch.Generator().manual_seed(0)
    data = batches(world)
    for batch in data:
        batch["action"] &= torch.rand(*batch.shape, 1, generator=rng) < 0.8
    poisoned = [batch.clone() for batch in data]
    for batch in poisoned:
        missed = ~batch["action"].all(-1)
        for place in (batch, batch["next"]):
            place["target"] = torch.randint_like(place["target"], 9, generator=rng)
            place["action_history"] = torch.rand(place["action_history"].shape, generator=rng) < 0.5
        batch["next", "reward"] = torch.randn(batch["next", "reward"].shape, generator=rng)
        batch["next", "last_cell"][missed] = torch.randint(9, (int(missed.sum()),), generator=rng)
    clean, other = (learn(world, each, *SHORT, name=name) for each in (data, poisoned))
    assert_same(clean.state_dict(), other.state_dict())


def test_the_same_seed_learns_the_same_and_another_does_not() -> None:
    world = small_world()
    data = batches(world)
    first, second, third = (learn(world, data, *SHORT, f"seed={seed}").state_dict() for seed in (0, 0, 1))
    assert_same(first, second)
    with pytest.raises(AssertionError):
        assert_same(first, third)


RESUMED = [*(("hindsight", (), saved_at) for saved_at in (3, 16, 17)), *((*variant, 17) for variant in VARIANTS)]


@pytest.mark.parametrize(("name", "words", "saved_at"), RESUMED)
def test_a_resumed_run_ends_as_the_unbroken_one(name: str, words: tuple[str, ...], saved_at: int) -> None:
    world = small_world()
    data = batches(world)
    whole, begun = learn(world, data, *SHORT, *words, name=name), algorithm(name, world, *SHORT, *words)
    steps = [*data, *[None] * (begun.iterations - len(data))]
    for batch in steps[:saved_at]:
        begun.step(batch)
    file = io.BytesIO()
    torch.save(begun.state_dict(), file)
    file.seek(0)
    resumed = algorithm(name, world, *SHORT, *words, "seed=5")
    resumed.load_state_dict(torch.load(file, weights_only=True))
    for batch in steps[saved_at:]:
        resumed.step(batch)
    assert_same(whole.state_dict(), resumed.state_dict())
    assert np.array_equal(policy(whole, world), policy(resumed, world))


def assert_same(first: Any, second: Any) -> None:
    """Equal to the last bit, through all containers."""
    if isinstance(first, dict):
        assert first.keys() == second.keys()
        for key in first:
            assert_same(first[key], second[key])
    elif isinstance(first, (list, tuple)):
        assert len(first) == len(second)
        for one, other in zip(first, second, strict=True):
            assert_same(one, other)
    elif isinstance(first, Tensor | TensorDict):
        assert bool((first == second).all())
    else:
        assert first == second


def test_collects_with_every_sensor_on() -> None:
    world = small_world()
    frames = batches(world, 1)[0]
    assert bool(frames["action"].all())


def test_learns_once_the_frames_are_in() -> None:
    world = small_world()
    learner = algorithm("hindsight", world, *SHORT)
    figures = [learner.step(batch) for batch in batches(world)]
    assert [row["updates"] for row in figures] == [0] * 16
    assert learner.iterations == 16 + 3
    assert [learner.step(None)["updates"] for _ in range(3)] == [10, 20, 30]


MIXED = ("algo.collect=mixed", "algo.explore.begin=0.25", "algo.explore.until=0.75", "algo.explore.end=0.1")


def test_mixed_learns_while_it_collects() -> None:
    """Of 16 batches 4 are sensed whole; the 12 others come with 10 updates each, and 20 are left."""
    world = small_world()
    learner = algorithm("hindsight", world, *SHORT, *MIXED, "algo.updates=140")
    assert learner.iterations == 16 + 2
    explore, updates = [], []
    for batch in [*batches(world), None, None]:
        updates.append(learner.step(batch)["updates"])
        explore.append(learner.policy.explore.item())
        if updates[-1]:
            assert torch.equal(learner.policy.chains, learner.actor.chains)
    assert updates == [0] * 4 + list(range(10, 150, 10))
    assert explore[:4] == [1.0] * 4
    assert explore[4:12] == pytest.approx(np.linspace(1, 0.1, 9)[1:], abs=1e-6)
    assert explore[12:] == pytest.approx([0.1] * 6)


def test_mixed_reaches_the_optimum_of_a_small_world() -> None:
    """Each batch is collected with the policy learned so far."""
    world = small_world(exit_probability=0.02)
    learner = algorithm("hindsight", world, *SOLVES, *MIXED, "algo.updates_per_iteration=25", "algo.total_frames=8192")
    torch.manual_seed(0)
    earned = []
    for number in range(learner.iterations):
        frames = collect(world, learner.policy, 32, 8, seed=number) if number < 32 else None
        earned += [] if frames is None else [frames["next", "reward"].mean().item()]
        learner.step(frames)
    best = optimal.solve(world, time_limit=5.0)
    assert regret_per_step(best.upper, evaluate(world, policy(learner, world))) < 0.01
    assert np.mean(earned[-8:]) > np.mean(earned[:8]) + 0.5


@pytest.mark.parametrize("saved_at", [3, 8, 17])
def test_a_resumed_mixture_goes_on_with_the_same_policy(saved_at: int) -> None:
    world, words = small_world(), (*SHORT, *MIXED, "algo.updates=130")
    data = [*batches(world), None]
    whole, begun, resumed = (algorithm("hindsight", world, *words) for _ in range(3))
    for batch in data:
        whole.step(batch)
    for batch in data[:saved_at]:
        begun.step(batch)
    file = io.BytesIO()
    torch.save(begun.state_dict(), file)
    file.seek(0)
    resumed.load_state_dict(torch.load(file, weights_only=True))
    assert_same(begun.policy.state_dict(), resumed.policy.state_dict())
    for batch in data[saved_at:]:
        resumed.step(batch)
    assert_same(whole.state_dict(), resumed.state_dict())
    assert_same(whole.policy.state_dict(), resumed.policy.state_dict())


def test_a_target_that_goes_farther_than_the_nets_see_is_gone() -> None:
    """On a 3x3 grid: 0 -> 1 -> 4 are steps of one, 4 -> 0 is diagonal, 1 -> 7 and 0 -> 2 are two; 9 is outside."""
    paths = torch.tensor([[0, 1, 4, 0], [1, 7, 4, 1], [0, 1, 9, 9], [4, 3, 0, 2]]).T
    expected = [[0, 1, 4, 0], [1, 9, 9, 9], [0, 1, 9, 9], [4, 3, 0, 9]]
    assert _within(paths, 1, 3).T.tolist() == expected
    assert torch.equal(_within(paths, 2, 3), paths)


def test_the_first_frames_of_a_mixture_decide_how_far_the_nets_see() -> None:
    """Later the target jumps from the upper half of the grid to its last cell: learning goes on as if it had left."""
    world = small_world(size=5)
    jumps, leaves = batches(world), batches(world)
    for number in range(16):
        first = jumps[number]["last_cell"]
        far = (first < 12) & (number >= 5)
        near = torch.where(first % 5 < 4, first + 1, first - 1)
        jumps[number]["next", "last_cell"] = torch.where(far, 24, near)
        leaves[number]["next", "last_cell"] = near
        for batch, exits in ((jumps[number], torch.zeros_like(far)), (leaves[number], far)):
            batch["next", "terminated"] = exits.unsqueeze(-1)
    words = (*SHORT, *MIXED, "algo.hidden=8")
    one, other = learn(world, jumps, *words), learn(world, leaves, *words)
    assert [learner._reach() for learner in (one, other)] == [4, 1]
    assert np.array_equal(policy(one, world), policy(other, world))
    parts = zip(one._learner.loss.parameters(), other._learner.loss.parameters(), strict=True)
    assert all(torch.equal(mine, theirs) for mine, theirs in parts)


def test_frames_without_a_move_are_refused_in_one_line() -> None:
    world = small_world()
    learner = algorithm("hindsight", world, *SHORT)
    for batch in batches(world):
        batch["action"].zero_()
        learner.step(batch)
    with pytest.raises(UserError, match=r"^algo\.total_frames: .*$"):
        learner.step(None)


def test_where_the_target_moves_alike_few_frames_are_enough() -> None:
    """144 cells and 12,000 frames: too few for each cell alone, plenty for all of them together."""
    kernel = random_walk(12, stay=0.2, diagonal=False, exit_probability=0.02, border="renormalize")
    alone = World(12, 1.0, np.full(144, 0.16), 144 * 0.16, 1, kernel)
    together = replace(alone, homogeneous=True)
    data = batches(alone, 47)
    upper = float(bounds.clocked(alone).mean())
    words = ("algo.updates=150", "algo.updates_per_iteration=150", "algo.batch_size=4096", "algo.hidden=32")
    regrets = [
        regret_per_step(upper, evaluate(world, policy(learn(world, data, "algo.total_frames=12032", *words), world)))
        for world in (alone, together)
    ]
    assert regrets[1] < 0.5 * regrets[0]
    assert regrets[1] < 0.02


def test_what_to_sense_is_shared_only_where_it_can_be() -> None:
    large, small = small_world(6, t_max=0), small_world(3, t_max=0)
    uneven = replace(large, cost=np.linspace(0.1, 0.2, 36))

    def shares(world: World) -> bool:
        rng = torch.Generator().manual_seed(0)
        loss = HindsightLoss(
            replace(world, homogeneous=True).task, Decision(), reach=1, hidden=4, discount=0.8, generator=rng
        )
        assert loss.critic.groups is loss.clocked_critic.groups is None
        return loss.actor.groups is not None and loss.clocked_actor.groups is not None

    assert shares(large)
    assert not shares(uneven)
    assert not shares(small)  # its outputs stand for cells
