"""Hindsight: learn the sensing policy from fully sensed paths, on which every policy can be replayed.

Sensing never moves the target. While collecting, all sensors are on, so every path shows what any policy would have
found and missed on it. Nothing else is read: neither the kernel nor a position that was not sensed.
"""

from __future__ import annotations

import copy
import math
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.nn.functional import pad, softplus

from trackmdp.algos.common import Averages, set_learning_rate
from trackmdp.algos.gains import chain_returns, clocked_advantage, sensing_gain
from trackmdp.algos.moves import MoveBuffer
from trackmdp.config.learning import Hindsight as HindsightConfig
from trackmdp.errors import UserError
from trackmdp.policies.chain_table import CellClockNet, Neighbourhood
from trackmdp.policies.fixed import AllOn, ChainPolicy
from trackmdp.seeding import generator
from trackmdp.world.model import Task

__all__ = ["Hindsight", "HindsightLoss", "decision_loss"]

_LARGEST_LOGIT = 20.0
_GAIN_SCALE_RATE = 0.1
_FEWEST_ROWS = 20
_LEAST_GAIN = 0.2
_LOSSES = ("clocked_actor", "clocked_critic", "actor", "critic")


class HindsightLoss(nn.Module):
    """Losses of the actor, the critic V and the clocked actor and critic, from segments of fully sensed paths.

    Rewards and costs are in units of r. Rows are deduplicated: located cells and clocks can be enumerated, so each net
    is run once on every (x, n), and a batch of any size enters as sums over its segments.

    Args:
        task: grid, rewards and costs.
        reach: the target gets no farther in one step, in rows and in columns.
        hidden: hidden units of each net.
        discount: γ of the credit.
        generator: draws the initial weights.
    """

    cost: Tensor
    clocks: Tensor
    gain_scale: Tensor

    def __init__(self, task: Task, *, reach: int, hidden: int, discount: float, generator: torch.Generator) -> None:
        super().__init__()
        m, choices, device = task.num_cells, task.num_choices, generator.device
        self.near = Neighbourhood(task.size, reach, device)
        self.view = Neighbourhood(task.size, choices * reach, device)

        def net(clocks: int, outputs: int, bias: float) -> CellClockNet:
            return CellClockNet(m, clocks, hidden=hidden, outputs=outputs, bias=bias, generator=generator)

        self.actor = net(choices, self.view.width, -1.0)
        self.critic = net(1, 1, 0.0)
        self.clocked_actor = net(choices, self.near.width, -1.0)
        self.clocked_critic = net(choices + 1, 1, 0.0)
        self.discount, self.safe = discount, 1.0 - task.safe_cost / task.reward
        cost = torch.as_tensor(task.cost / task.reward, dtype=torch.float32, device=device)
        self.register_buffer("cost", pad(cost, (0, 1)))
        self.register_buffer("clocks", torch.arange(choices, device=device).unsqueeze(-1))
        self.register_buffer("gain_scale", torch.ones(2, choices, device=device))

    def forward(self, cells: Tensor, on: Tensor, blend: float) -> dict[str, Tensor]:
        """The losses, each under the name of the net that it trains.

        Args:
            cells: int64 `[T+3, B]`, segments: the located cell, then the cells sensed next, M once outside.
            on: bool `[M, T+1, K]`, the sensors that the replayed policy switches on, as the actor's outputs.
            blend: λ of the gain.
        """
        clocked = self.clocked_critic().squeeze(-1)
        # U(x, T+1) holds r - D for certain; the net learns the rest.
        clocked = torch.cat([clocked[:, :-1], clocked[:, -1:] + self.safe], dim=1)
        advantage = pad(clocked_advantage(clocked.detach()), (0, 1))
        return self._clocked(cells, clocked, advantage) | self._own(cells, on, advantage, blend)

    def _clocked(self, cells: Tensor, clocked: Tensor, advantage: Tensor) -> dict[str, Tensor]:
        """From one move of each segment, at every clock: the position is revealed after every action."""
        near, known = self.near, pad(clocked.detach(), (0, 0, 0, 1))
        m, k = near.cells.shape
        start, end = cells[0], cells[1]
        logits = self.clocked_actor()
        moves = _sum((end < m).float(), start * k + near.index(start, end), m * k).view(m, 1, k)
        stays, visits = moves.sum(-1), torch.bincount(start, minlength=m).unsqueeze(-1)
        gain = moves * sensing_gain(advantage[:, near.cells].transpose(0, 1), reward=1.0, discount=self.discount)
        chosen = logits.detach() > 0
        spent = stays * (chosen * self.cost[near.cells].unsqueeze(1)).sum(-1)
        following = self.discount * torch.bmm(moves, known[near.cells]).squeeze(1)
        free = following[:, 1:] + (gain * chosen).sum(-1) - spent
        target = torch.cat([free, following[:, :1] + self.safe * stays], dim=1) / visits.clamp(min=1)
        error = visits * (clocked - target).square()
        return {
            "clocked_actor": self._decide(0, logits, gain.clamp(min=0), gain.clamp(max=0).neg(), stays, near),
            "clocked_critic": error.sum() / cells.shape[1],
        }

    def _own(self, cells: Tensor, on: Tensor, advantage: Tensor, blend: float) -> dict[str, Tensor]:
        """From whole segments: the policy's chain is followed from their first cell until it detects or is forced."""
        view, discount = self.view, self.discount
        m, choices, k = on.shape
        start, moves, end = cells[0], cells[1:], cells[1:-1]
        logits, value = self.actor(), self.critic().view(m)
        row = start * choices + self.clocks
        entry = row * k + view.index(start, end)
        hits, inside = _look(on, entry) & (end < m), moves < m
        located = _look(pad(value.detach(), (0, 1)), moves)
        spent = _look((on * self.cost[view.cells].unsqueeze(1)).sum(-1), row)
        returns = chain_returns(hits, inside, spent, located, reward=1.0, safe_cost=1.0 - self.safe, discount=discount)
        clocked = _look(advantage, self.clocks * (m + 1) + end)
        gain = sensing_gain(clocked, located[:-1] - returns[1:], reward=1.0, discount=discount, blend=blend)
        alive = inside[:-1].clone()
        for n in range(1, choices):
            alive[n] &= alive[n - 1] & ~hits[n - 1]
        gain = gain * alive
        sums = _sum(gain.abs(), entry + logits.numel() * (gain < 0), 2 * logits.numel())
        plus, minus = sums.view(2, m, choices, k)
        arrivals = _sum(alive.float(), row, m * choices).view(m, choices)
        visits = torch.bincount(start, minlength=m)
        error = visits * (value - _sum(returns[0], start, m) / visits.clamp(min=1)).square()
        return {
            "actor": self._decide(1, logits, plus, minus, arrivals, view),
            "critic": error.sum() / cells.shape[1],
        }

    def _decide(
        self, which: int, logits: Tensor, plus: Tensor, minus: Tensor, arrivals: Tensor, view: Neighbourhood
    ) -> Tensor:
        """Decision loss, each clock by its own number of rows and its running mean gain, so that rare clocks count."""
        count = arrivals.expand(-1, logits.shape[1]).sum(0)
        mean = (plus + minus).sum((0, 2)) / count.clamp(min=1)
        self.gain_scale[which].lerp_(mean, _GAIN_SCALE_RATE)
        weight = 1.0 / (count.clamp(min=_FEWEST_ROWS) * self.gain_scale[which].clamp(min=_LEAST_GAIN))
        price = arrivals.unsqueeze(-1) * self.cost[view.cells].unsqueeze(1)
        return (decision_loss(logits, plus, minus, price).sum((0, 2)) * weight).sum()


def decision_loss(logits: Tensor, plus: Tensor, minus: Tensor, price: Tensor) -> Tensor:
    """Cost-sensitive logistic loss of each sensor: (c + G⁻) softplus(z) + G⁺ softplus(-z).

    Its minimum over z is at log(G⁺ / (c + G⁻)), positive exactly where sensing pays: G⁺ - G⁻ > c. On the log scale a
    cell where the target seldom is needs no more accuracy than one where it often is.

    Args:
        logits: z.
        plus: G⁺, sum of the positive gains.
        minus: G⁻, minus the sum of the negative ones.
        price: c, what having the sensor on costs in sum.
    """
    # Beyond the clamp nothing is left to learn, and without it logits run off to where floats lose precision.
    logits = logits.clamp(-_LARGEST_LOGIT, _LARGEST_LOGIT)
    return (price + minus + plus) * softplus(logits) - plus * logits


def budget(task: Task, cfg: HindsightConfig) -> tuple[int, int]:
    """Updates and hidden units: as configured, else by the number of rows (x, n) that the actor has to get right."""
    few = task.num_cells * task.num_choices <= 300
    return cfg.updates or (500 if few else 800), cfg.hidden or (128 if few else 256)


def _look(table: Tensor, index: Tensor) -> Tensor:
    """`table.flatten()[index]`, the fastest way."""
    return table.reshape(-1).index_select(0, index.reshape(-1)).view(index.shape)


def _sum(values: Tensor, index: Tensor, length: int) -> Tensor:
    """`[length]`, the sums of the `values` that share an `index`."""
    return values.new_zeros(length).scatter_add_(0, index.reshape(-1), values.reshape(-1))


class Hindsight:
    """Collects with all sensors on; once the frames are in, learns from them alone.

    The nets see the target's neighbourhood as far as the frames have shown it to move, so they are made after those.
    """

    def __init__(self, task: Task, cfg: HindsightConfig, *, iterations: int, seed: int, device: torch.device) -> None:
        self.task, self.cfg, self.device = task, cfg, device
        self.updates, self.hidden = budget(task, cfg)
        self._collecting, self._iteration, self._update = iterations, 0, 0
        self.iterations = iterations + -(-self.updates // cfg.updates_per_iteration)
        self._generator = generator(seed, "hindsight", device=device)
        self._buffer = MoveBuffer(task.num_cells, cfg.buffer_size, self._generator)
        self._learner: _Learner | None = None
        self.policy = AllOn(task.num_cells)
        shape = (task.num_cells, task.num_choices, task.num_cells)
        self.actor = ChainPolicy(np.zeros(shape, dtype=bool), device=device)

    def step(self, batch: TensorDictBase | None) -> dict[str, float]:
        """Store one batch `[B, time]`; after the last one, `updates_per_iteration` updates."""
        self._iteration += 1
        if batch is not None:
            self._buffer.extend(batch)
        averages, cfg = Averages(), self.cfg
        if self._iteration >= self._collecting + 1:
            learner = self._learner = self._learner or self._make_learner(self._reach())
            for _ in range(min(cfg.updates_per_iteration, self.updates - self._update)):
                progress = self._update / self.updates
                cells = self._buffer.paths(cfg.batch_size, self.task.t_max + 2)
                averages.add(**learner.update(cells, cfg.learning_rate.at(progress), cfg.blend.at(progress)))
                self._update += 1
            self.actor.chains.copy_(learner.chains())
        losses = averages.means() or dict.fromkeys(_LOSSES, math.nan)
        return {"moves": len(self._buffer), "updates": self._update} | {f"loss_{k}": v for k, v in losses.items()}

    def state_dict(self) -> dict[str, Any]:
        """Counters, generator, segments, and once they exist the nets with all that trains them."""
        learner = self._learner
        return {
            "iteration": self._iteration,
            "update": self._update,
            "generator": self._generator.get_state(),
            "buffer": self._buffer.state_dict(),
            "chains": self.actor.chains.clone(),
            "learner": None if learner is None else learner.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a `state_dict`."""
        self._iteration, self._update = state["iteration"], state["update"]
        self._buffer.load_state_dict(state["buffer"])
        self.actor.chains.copy_(state["chains"])
        self._learner = None
        if state["learner"] is not None:
            self._learner = self._make_learner(state["learner"]["reach"])
            self._learner.load_state_dict(state["learner"])
        self._generator.set_state(state["generator"].cpu())

    def _make_learner(self, reach: int) -> _Learner:
        loss = HindsightLoss(
            self.task, reach=reach, hidden=self.hidden, discount=self.cfg.gamma, generator=self._generator
        )
        return _Learner(loss, self.cfg.average)

    def _reach(self) -> int:
        """The farthest the target was seen to move in one step, in rows or in columns.

        Raises:
            UserError: it was never seen to move.
        """
        if not len(self._buffer):
            raise UserError("algo.total_frames: in none of them was a target located and sensed again; expected more")
        size, (start, end) = self.task.size, self._buffer.moves()
        moved = torch.maximum((start // size - end // size).abs(), (start % size - end % size).abs())
        return int(moved.masked_fill_(end == self.task.num_cells, 0).max())


class _Learner:
    """The nets, their optimizer, and the running average of the actor, which is replayed and judged."""

    def __init__(self, loss: HindsightLoss, average: float) -> None:
        self.loss, self._decay, self._count = loss, average, 0
        self.average = copy.deepcopy(loss.actor).requires_grad_(False)
        self.optimizer = torch.optim.Adam(loss.parameters(), lr=0.0, betas=(0.9, 0.99), fused=True)

    def update(self, cells: Tensor, rate: float, blend: float) -> dict[str, Tensor]:
        """One gradient step on segments `cells` `[T+3, B]`; returns the losses."""
        set_learning_rate(self.optimizer, rate)
        losses = self.loss(cells, self._on(), blend)
        self.optimizer.zero_grad()
        torch.stack(list(losses.values())).sum().backward()
        self.optimizer.step()
        # At first the average forgets faster, or it would stay with the initial weights.
        decay = min(self._decay, (1 + self._count) / (10 + self._count))
        self._count += 1
        with torch.no_grad():
            for mean, weight in zip(self.average.parameters(), self.loss.actor.parameters(), strict=True):
                mean.lerp_(weight, 1.0 - decay)
        return losses

    @torch.no_grad()
    def _on(self) -> Tensor:
        """`[M, T+1, K]`, the sensors on, as the actor's outputs."""
        return self.average() > 0

    def chains(self) -> Tensor:
        """`[M, T+1, M]` bool, the policy."""
        return self.loss.view.spread(self._on())

    def state_dict(self) -> dict[str, Any]:
        return {
            "reach": self.loss.near.radius,
            "loss": self.loss.state_dict(),
            "average": self.average.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "count": self._count,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.loss.load_state_dict(state["loss"])
        self.average.load_state_dict(state["average"])
        self.optimizer.load_state_dict(state["optimizer"])
        self._count = state["count"]
