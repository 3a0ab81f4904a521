"""Losses of an actor that has one logit z per sensor, all four from the same gains of sensing.

z > 0 means on, and each loss has its optimum at z > 0 exactly where sensing pays, G⁺ - G⁻ > c. They differ in their
gradients: those of the policy-gradient forms carry the factor σ(z)(1-σ(z)), which vanishes at saturated logits; the
two others do not.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import torch
from torch import Tensor, nn
from torch.nn.functional import logsigmoid, softplus

from trackmdp.algos.gains import gather, scatter_add
from trackmdp.config.learning import ScheduleConfig

# σ(20) differs from 1 by 2e-9: larger logits are certainty. e^6 = 403: gains up to 403 times the cost differ in their
# logits. |z| = 4 is a probability of 1.8 or 98.2 %.
_LARGEST_LOGIT = 20.0
_LARGEST_LOG_RATIO = 6.0
_SOFT_LIMIT = 4.0
_PULL = 0.1
# Of sets that cool down, at the end: |z| = .2 is a probability of 1.8 or 98.2 %.
_COOLEST = 0.05


@dataclass(frozen=True)
class SensorCredit:
    """Statistics of replayed paths for every sensor at every row (x, n) of the policy's table.

    Attributes:
        entry: int64 `[T+1, B]`, for each path and clock the place in `[M, T+1, C]` of the cell the target moved to.
        gain: `[T+1, B]`, gain of seeing it there; 0 where the path did not get to the clock unlocated.
        arrivals: `[M, T+1]`, paths at each row.
        price: `[M, T+1, K]`, cost of having a sensor on on all of them.
        rows: the located cells that these tables are of, where they are a part of all M.
        of_sensors: gains of sensors `[M, T+1, K]`, from the gains `[M, T+1, C]` of seeing the cells; the same where
            each sensor has a cell of its own.
        cells: C, where it is not K.
    """

    entry: Tensor
    gain: Tensor
    arrivals: Tensor
    price: Tensor
    rows: slice = field(default_factory=lambda: slice(None))
    of_sensors: Callable[[Tensor], Tensor] = lambda gain: gain
    cells: int | None = None

    @cached_property
    def signed(self) -> tuple[Tensor, Tensor]:
        """G⁺ and G⁻ `[M, T+1, K]`, the sum of the positive gains, and minus the sum of the negative ones."""
        shape = (*self.arrivals.shape, self.cells or self.price.shape[-1])
        size = math.prod(shape)
        # One scatter for both signs: with 32 entries, a gain of -.5 at entry 30 adds .5 to place 30 + 32 = 62, the
        # second half.
        negative = self.entry + size * (self.gain < 0)
        plus, minus = scatter_add(self.gain.abs(), negative, 2 * size).view(2, *shape)
        return self.of_sensors(plus), self.of_sensors(minus)

    @cached_property
    def advantage(self) -> Tensor:
        """Δ = G⁺ - G⁻ - c `[M, T+1, K]`, worth of a sensor on over off."""
        plus, minus = self.signed
        return plus - minus - self.price

    def sampled(self, on: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Δ `[M, T+1, K]` of the paths on which a sensor was drawn on, and of those on which it was off.

        Every path draws its own set. Sensors that a path does not move to differ only in their cost there, so their
        number of draws is enough.

        Args:
            on: `[M, T+1, K]`, probabilities.
            generator: draws the sets.
        """
        size, shape = on.numel(), on.shape
        # A gain of 0 is a path that did not get to this clock, or moved out of view: no sensor earns anything there.
        moved = self.gain != 0
        drawn = torch.rand(self.gain.shape, generator=generator, device=on.device) < gather(
            on, self.entry
        )
        moves = scatter_add(moved.float(), self.entry, size)
        gains = scatter_add(self.gain, self.entry, size)
        moves_on = scatter_add((moved & drawn).float(), self.entry, size).view(shape)
        gains_on = scatter_add(self.gain * drawn, self.entry, size).view(shape)
        arrivals = self.arrivals.unsqueeze(-1)
        # On the other paths at this row the sensor's draw matters only through how many came up on: a binomial number,
        # one draw for the sensor in place of one per path.
        paths_on = moves_on + torch.binomial(arrivals - moves.view(shape), on, generator=generator)
        # `price` is over all arrivals; per path it is c.
        unit = self.price / arrivals.clamp(min=1)
        return gains_on - unit * paths_on, gains.view(shape) - gains_on - unit * (
            arrivals - paths_on
        )


class ActorLoss(nn.Module):
    """Base: the loss of every sensor at every row. Sums over paths; the caller weighs them."""

    def __init__(self) -> None:
        super().__init__()
        self._heat = 1.0

    def allocate(self, shape: tuple[int, int, int], device: torch.device) -> None:
        """Make all parts that depend on the shape (M, T+1, K) of the logits; called once."""

    def prepare(self, update: int, progress: float) -> None:  # noqa: ARG002
        """Set the parameters that change in the course of a run, before update number `update`."""
        self._heat = _COOLEST**progress

    def acting(self, logits: Tensor) -> Tensor:
        """`[M, T+1, K]`, probabilities of sensors on, on which the gains of sensors with shared cells depend.

        A loss with its minimum at z = log(gain / price) makes σ(z) no acting probability: at σ(z) two sensors of the
        same cells would stay on at half the gain each. The sets cool down to z > 0 in the course of a run; hard sets
        from the start would stay in the local optimum of the first few updates.
        """
        return (logits / self._heat).sigmoid()

    def forward(self, logits: Tensor, credit: SensorCredit) -> Tensor:
        """`[M, T+1, K]` losses of `logits` z `[M, T+1, K]`."""
        raise NotImplementedError


class Decision(ActorLoss):
    """Cost-sensitive classification, `decision_loss`; hindsight's own."""

    def forward(self, logits: Tensor, credit: SensorCredit) -> Tensor:
        """(c + G⁻) softplus(z) + G⁺ softplus(-z)."""
        return decision_loss(logits, *credit.signed, credit.price)


class PolicyGradient(ActorLoss):
    """A2C over all actions: -σ(z)Δ - βH(σ(z)), the expected advantage of each sensor instead of a sampled one's.

    Beyond |z| = 4 z is pulled back: where σ(z)(1-σ(z)) vanishes, a sensor would not learn that its gain has changed.

    Args:
        entropy: β, in units of r.
    """

    def __init__(self, entropy: ScheduleConfig) -> None:
        super().__init__()
        self._schedule, self._entropy = entropy, entropy.start

    def prepare(self, update: int, progress: float) -> None:
        """Set β."""
        super().prepare(update, progress)
        self._entropy = self._schedule.at(progress)

    def forward(self, logits: Tensor, credit: SensorCredit) -> Tensor:
        """-(objective) - β n H(σ(z)) + n/10 (|z| - 4)²₊, where n paths arrive."""
        on = logits.sigmoid()
        entropy = -(on * logsigmoid(logits) + (1 - on) * logsigmoid(-logits))
        beyond = (logits.abs() - _SOFT_LIMIT).clamp(min=0)
        held = _PULL * beyond.square() - self._entropy * entropy
        return credit.arrivals.unsqueeze(-1) * held - self.objective(logits, credit)

    def acting(self, logits: Tensor) -> Tensor:
        """σ(z): each sensor's gain is then the exact slope of the expected value of a set, footprints or not."""
        return logits.sigmoid()

    def objective(self, logits: Tensor, credit: SensorCredit) -> Tensor:
        """The gain of the policy, to be maximised."""
        # The expected value of a set is Σ_j σ(z_j) Δ_j: gains add over sensors, and no set need be drawn. With
        # footprints Δ_j depends on the others, held fixed here, and the slope is the same.
        return logits.sigmoid() * credit.advantage


class Surrogate(PolicyGradient):
    """PPO per sensor: ratio ρ, advantage and clip belong to one sensor being on (ρ₁, σ) or off (ρ₀, 1-σ).

    Σ_b min(ρ_b A_b, clip(ρ_b) A_b) with A₁ = (1-p)Δ₁ and A₀ = -pΔ₀, where p is the old policy's probability and Δ_b is
    summed over the paths with the sensor on or off: in expectation (Δ₁ = pΔ, Δ₀ = (1-p)Δ), or as the old policy draws.

    Args:
        entropy: β, in units of r.
        clip_epsilon: ε, how far a ratio may leave 1.
        minibatches: updates from one renewal of the old policy to the next.
        generator: draws the sensors; None for the expectation.
    """

    def __init__(
        self,
        entropy: ScheduleConfig,
        *,
        clip_epsilon: float,
        minibatches: int,
        generator: torch.Generator | None,
    ) -> None:
        super().__init__(entropy)
        self._epsilon = clip_epsilon
        self._minibatches = minibatches
        self._generator = generator
        self._renew = True

    def allocate(self, shape: tuple[int, int, int], device: torch.device) -> None:
        """Room for the old policy's logits."""
        self.old = nn.Buffer(torch.zeros(shape, device=device))

    def prepare(self, update: int, progress: float) -> None:
        """Set β, and whether the old policy is renewed."""
        super().prepare(update, progress)
        self._renew = update % self._minibatches == 0

    def objective(self, logits: Tensor, credit: SensorCredit) -> Tensor:
        """Σ_b min(ρ_b A_b, clip(ρ_b) A_b)."""
        old = self.old[credit.rows]
        if self._renew:
            old.copy_(logits.detach())
        # Sensor on is worth Δ, off 0, on average pΔ: advantages (1 - p) Δ and -pΔ, each weighted by the paths that have
        # it.
        p = old.sigmoid()
        if self._generator is None:
            on, off = p * credit.advantage, (1 - p) * credit.advantage
        else:
            on, off = credit.sampled(p, self._generator)
        # Ratios as differences of logarithms: σ(z) / σ(z_old) would be 0 / 0 at very negative logits.
        up = (logsigmoid(logits) - logsigmoid(old)).exp()
        down = (logsigmoid(-logits) - logsigmoid(-old)).exp()
        return self._clipped(up, (1 - p) * on) + self._clipped(down, -p * off)

    def _clipped(self, ratio: Tensor, advantage: Tensor) -> Tensor:
        # The lesser of the two: no reward for leaving the clip range, no protection for having left it the wrong way
        # (Schulman et al. 2017, eq. 7).
        near = ratio.clamp(1 - self._epsilon, 1 + self._epsilon)
        return torch.minimum(ratio * advantage, near * advantage)


class Poisson(ActorLoss):
    """DQN: the Q that adds up over the sensors, Q = b + Σ a_j q_j with q = c(e^z - 1), by the loss c e^z - (G⁺ - G⁻)z.

    At its minimum c e^z is the gain of the sensor and q its worth on over off. A squared error would have to separate
    gains from costs where both are tiny; on the log scale cells where the target seldom is are no harder.
    """

    def forward(self, logits: Tensor, credit: SensorCredit) -> Tensor:
        """C e^z - (G⁺ - G⁻) z, z no larger than for any gain."""
        z = logits.clamp(-_LARGEST_LOGIT, _LARGEST_LOG_RATIO)
        # Derivative in z: c e^z - (G⁺ - G⁻), zero at e^z = (G⁺ - G⁻) / c, which is above 1 exactly where sensing pays.
        plus, minus = credit.signed
        return credit.price * z.exp() - (plus - minus) * z


def decision_loss(logits: Tensor, plus: Tensor, minus: Tensor, price: Tensor) -> Tensor:
    """Cost-sensitive logistic loss of each sensor: (c + G⁻) softplus(z) + G⁺ softplus(-z).

    Its minimum over z is at log(G⁺ / (c + G⁻)), positive exactly where sensing pays: G⁺ - G⁻ > c. On the log scale a
    cell where the target seldom is needs no more accuracy than one where it often is.

    Args:
        logits: z.
        plus: G⁺, sum of the positive gains.
        minus: G⁻, minus the sum of the negative ones.
        price: c, sum of the costs of the sensor on.
    """
    # Beyond the clamp nothing is left to learn, and without it logits run off to where floats lose precision.
    logits = logits.clamp(-_LARGEST_LOGIT, _LARGEST_LOGIT)
    # softplus(-z) = softplus(z) - z, so one softplus does for both terms. Derivative: (c + G⁻) σ(z) - G⁺ (1 - σ(z)),
    # zero at e^z = G⁺ / (c + G⁻).
    return (price + minus + plus) * softplus(logits) - plus * logits
