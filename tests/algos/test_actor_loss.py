from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from trackmdp.algos.actor_loss import (
    ActorLoss,
    Decision,
    Poisson,
    PolicyGradient,
    SensorCredit,
    Surrogate,
)
from trackmdp.config.learning import ScheduleConfig

LOSSES: dict[str, Callable[[], ActorLoss]] = {
    "decision": Decision,
    "policy gradient": lambda: PolicyGradient(flat(0.05)),
    "surrogate": lambda: surrogate(0.05),
    "poisson": Poisson,
}


def flat(value: float) -> ScheduleConfig:
    return ScheduleConfig(start=value, end=value, begin=0.0, until=1.0)


def surrogate(
    entropy: float, *, clip: float = 0.2, sampled: bool = False, minibatches: int = 1
) -> Surrogate:
    rng = torch.Generator().manual_seed(0) if sampled else None
    loss = Surrogate(flat(entropy), clip_epsilon=clip, minibatches=minibatches, generator=rng)
    loss.allocate((1, 1, 1), torch.device("cpu"))
    return loss


def one_sensor(plus: float, minus: float, price: float, arrivals: int = 10) -> SensorCredit:
    """One row of ten paths and one sensor, which two of them move to."""
    gain = torch.zeros(1, arrivals, dtype=torch.float64)
    gain[0, :2] = torch.tensor([plus, -minus], dtype=torch.float64)
    entry = torch.zeros(1, arrivals, dtype=torch.int64)
    shape = (1, 1, 1)
    return SensorCredit(
        entry, gain, gain.new_full(shape[:2], arrivals), gain.new_full(shape, price)
    )


def logit(value: float) -> Tensor:
    return torch.full((1, 1, 1), value, dtype=torch.float64, requires_grad=True)


def value_and_slope(loss: ActorLoss, z: float, credit: SensorCredit) -> tuple[float, float]:
    at = logit(z)
    loss.double()
    value = loss(at, credit).sum()
    value.backward()
    assert at.grad is not None
    return value.item(), at.grad.item()


def test_credit_adds_up_by_hand() -> None:
    """Two rows (x = 0, n = 0 and 1) and three sensors; of three paths one is located at n = 0, and one has left."""
    entry = torch.tensor([[0, 2, 0], [4, 5, 3]])
    gain = torch.tensor([[3.0, -0.5, 1.0], [2.0, 0.0, 0.0]])
    price = torch.tensor([[[0.25, 0.5, 0.75], [0.1, 0.2, 0.3]]])
    credit = SensorCredit(entry, gain, torch.tensor([[3.0, 1.0]]), price)
    plus, minus = credit.signed
    assert plus.tolist() == [[[4.0, 0.0, 0.0], [0.0, 2.0, 0.0]]]
    assert minus.tolist() == [[[0.0, 0.0, 0.5], [0.0, 0.0, 0.0]]]
    torch.testing.assert_close(
        credit.advantage, torch.tensor([[[3.75, -0.5, -1.25], [-0.1, 1.8, -0.3]]])
    )


def test_losses_by_hand() -> None:
    """At z = ln 3, σ = 3/4: G⁺ = 4, G⁻ = 1, c = 2, so Δ = 1."""
    z, entropy = math.log(3), -(0.75 * math.log(0.75) + 0.25 * math.log(0.25))
    credit = one_sensor(4.0, 1.0, 2.0)
    expected = {
        "decision": 3 * math.log(4) + 4 * math.log(4 / 3),
        "policy gradient": -0.75 - 0.05 * 10 * entropy,
        "surrogate": -(0.75 * 0.25 - 0.25 * 0.75)
        - 0.05 * 10 * entropy,  # both ratios are 1 at the old policy
        "poisson": 2 * 3 - 3 * z,
    }
    for name, make in LOSSES.items():
        assert value_and_slope(make(), z, credit)[0] == pytest.approx(expected[name]), name


@given(st.floats(-3, 3), st.floats(0, 3), st.floats(0, 3), st.floats(0.01, 2))
def test_slopes_are_those_of_the_formulas(
    z: float, plus: float, minus: float, price: float
) -> None:
    """PG: -σ(1-σ)Δ + βnσ(1-σ)z, which the surrogate shares at the old policy; Poisson: c e^z - (G⁺ - G⁻)."""
    credit, on = one_sensor(plus, minus, price), 1 / (1 + math.exp(-z))
    gradient = -on * (1 - on) * (plus - minus - price - 0.05 * 10 * z)
    expected = {
        "decision": (price + minus + plus) * on - plus,
        "policy gradient": gradient,
        "surrogate": gradient,
        "poisson": price * math.exp(z) - (plus - minus),
    }
    for name, make in LOSSES.items():
        assert value_and_slope(make(), z, credit)[1] == pytest.approx(expected[name], abs=1e-9), (
            name
        )


@pytest.mark.parametrize("name", LOSSES)
@pytest.mark.parametrize(("plus", "on"), [(2.5, True), (1.5, False)])
def test_a_sensor_goes_on_exactly_where_its_gain_exceeds_its_price(
    name: str, plus: float, on: bool
) -> None:
    """G⁻ = 1/2 and c = 3/2, descended from either side; no loss learns past where it is sure."""
    for start in (-3.0, 3.0):
        z, loss, credit = logit(start), LOSSES[name](), one_sensor(plus, 0.5, 1.5)
        loss.double()
        for update in range(400):
            loss.prepare(update, 0.0)
            (slope,) = torch.autograd.grad(loss(z, credit).sum(), z)
            with torch.no_grad():
                z -= 0.5 * slope
        assert (z.item() > 0) == on, (start, z.item())
        assert abs(z.item()) < 5


def test_the_policy_gradient_pulls_saturated_sensors_back() -> None:
    """Beyond 4 by n/10 per unit and twice the excess; σ(1-σ) alone would leave them there."""
    credit = one_sensor(0.0, 0.0, 1.0)
    slope = value_and_slope(PolicyGradient(flat(0.0)), 6.0, credit)[1]
    on = 1 / (1 + math.exp(-6))
    assert slope == pytest.approx(on * (1 - on) + 0.1 * 10 * 2 * 2.0)


@pytest.mark.parametrize("advantage", [1.0, -1.0])
@pytest.mark.parametrize("new", [0.05, 0.55, 0.95])
def test_the_surrogate_is_clipped_per_action(advantage: float, new: float) -> None:
    """Old p = 1/2: Σ_b min(ρ_b A_b, clip(ρ_b) A_b) with ρ₁ = 2p', ρ₀ = 2(1-p'), A₁ = Δ/4, A₀ = -Δ/4."""
    loss = surrogate(0.0, minibatches=2)
    loss.prepare(0, 0.0)
    credit = one_sensor(advantage + 1.0, 0.0, 1.0)
    assert value_and_slope(loss, 0.0, credit)[0] == pytest.approx(0.0)
    loss.prepare(1, 0.0)
    part = 0.25 * advantage
    terms = [(2 * new, part), (2 * (1 - new), -part)]
    expected = sum(min(ratio * worth, min(max(ratio, 0.8), 1.2) * worth) for ratio, worth in terms)
    at = math.log(new / (1 - new))
    value, slope = value_and_slope(loss, at, credit)
    assert value == pytest.approx(-expected)
    rewarded = (new > 0.6 and advantage > 0) or (new < 0.4 and advantage < 0)
    free = new * (1 - new) * advantage
    assert slope == pytest.approx(0.0 if rewarded else -free, abs=1e-12)


def test_the_old_policy_is_renewed_once_per_batch() -> None:
    loss, credit = surrogate(0.0, minibatches=3), one_sensor(1.0, 0.0, 0.5)
    seen = []
    for update in range(7):
        loss.prepare(update, 0.0)
        loss(torch.full((1, 1, 1), float(update)), credit)
        seen.append(loss.old.item())
    assert seen == [0, 0, 0, 3, 3, 3, 6]


def paths(
    count: int, seed: int, unit: tuple[float, float, float] = (0.1, 0.2, 0.3)
) -> tuple[SensorCredit, Tensor]:
    """Rows of three sensors at two clocks, most paths at the first one, with gains of either sign."""
    rng = torch.Generator().manual_seed(seed)
    entry = torch.randint(3, (2, count), generator=rng) + torch.tensor([[0], [3]])
    alive = torch.rand(2, count, generator=rng) < torch.tensor([[1.0], [0.4]])
    gain = (torch.randn(2, count, generator=rng) + 1.0) * alive
    arrivals = alive.sum(1).float().view(1, 2)
    price = arrivals.unsqueeze(-1) * torch.tensor(unit)
    return SensorCredit(entry, gain, arrivals, price), torch.rand(1, 2, 3, generator=rng)


def test_sampled_credit_adds_up_to_all_of_it() -> None:
    credit, on = paths(200, 0)
    up, down = credit.sampled(on, torch.Generator().manual_seed(1))
    torch.testing.assert_close(up + down, credit.advantage)
    everything = credit.sampled(torch.ones_like(on), torch.Generator())
    torch.testing.assert_close(everything[0], credit.advantage)
    assert everything[1].abs().max() < 1e-4


def test_sampled_credit_is_right_on_average() -> None:
    """pΔ and (1-p)Δ, within five standard errors of 1000 draws."""
    credit, on = paths(50, 2)
    rng = torch.Generator().manual_seed(3)
    draws = torch.stack([credit.sampled(on, rng)[0] for _ in range(1000)])
    error = (draws.mean(0) - on * credit.advantage).abs()
    assert bool((error < 5 * draws.std(0) / 1000**0.5).all())


@pytest.mark.parametrize("unit", [(0.1, 0.2, 0.3), (1.0, 2.0, 3.0)])
def test_sampled_credit_varies_as_paths_that_draw_their_own_sets_do(
    unit: tuple[float, float, float],
) -> None:
    """Against drawing every path's whole set: the same variances, within sampling error."""
    credit, on = paths(50, 4, unit)
    rng = torch.Generator().manual_seed(5)
    alive = credit.gain != 0

    def dense() -> Tensor:
        drawn = torch.rand(2, 50, 3, generator=rng) < on.view(2, 1, 3)
        moved = torch.nn.functional.one_hot(credit.entry % 3, 3) * credit.gain.unsqueeze(-1)
        return ((moved - torch.tensor(unit) * alive.unsqueeze(-1)) * drawn).sum(1)

    ours = torch.stack([credit.sampled(on, rng)[0] for _ in range(1000)]).var(0).view(2, 3)
    theirs = torch.stack([dense() for _ in range(1000)]).var(0)
    torch.testing.assert_close(ours, theirs, rtol=0.3, atol=1e-3)


def test_the_sampled_surrogate_has_the_slope_of_the_expected_one_on_average() -> None:
    """At the old policy; the baseline p is what makes an action drawn by chance no evidence for it."""
    credit, on = paths(50, 6)
    loss = Surrogate(
        flat(0.0), clip_epsilon=0.2, minibatches=1, generator=torch.Generator().manual_seed(7)
    )
    loss.allocate((1, 2, 3), torch.device("cpu"))
    z = on.logit().requires_grad_()
    slopes = torch.stack([torch.autograd.grad(loss(z, credit).sum(), z)[0] for _ in range(800)])
    error = (slopes.mean(0) + on * (1 - on) * credit.advantage).abs()
    assert bool((error < 5 * slopes.std(0) / 800**0.5 + 1e-6).all())
