"""The losses of hindsight learning, from paths whose every cell was sensed."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from trackmdp.algos.actor_loss import ActorLoss, SensorCredit, decision_loss
from trackmdp.algos.gains import chain_returns, clocked_advantage, sensing_gain
from trackmdp.algos.tables import look, total
from trackmdp.policies.chain_table import CellClockNet, Neighbourhood
from trackmdp.world.model import Task

__all__ = ["HindsightLoss"]

_GAIN_SCALE_RATE = 0.1
_FEWEST_ROWS = 20
_LEAST_GAIN = 0.2


class HindsightLoss(nn.Module):
    """Losses of the actor, the critic V and the clocked actor and critic, from fully sensed paths.

    Rewards and costs are in units of r. Rows are deduplicated: located cells and clocks can be enumerated, so each net
    is run once on every (x, n), and a batch of any size enters as sums over its paths.

    Args:
        task: grid, rewards and costs.
        actor_loss: of the actor; the clocked actor always has the decision loss.
        reach: the target gets no farther in one step, in rows and in columns.
        hidden: hidden units of each net.
        discount: γ of the credit.
        generator: draws the initial weights.
    """

    cost: Tensor
    clocks: Tensor
    gain_scale: Tensor

    def __init__(
        self,
        task: Task,
        actor_loss: ActorLoss,
        *,
        reach: int,
        hidden: int,
        discount: float,
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        m, choices, device = task.num_cells, task.num_choices, generator.device
        self.near = Neighbourhood(task.size, reach, device)
        self.view = Neighbourhood(task.size, choices * reach, device)

        # Where the target moves alike and sensors cost alike, what to sense is learned once for all such cells; values
        # stay each cell's own.
        alike = task.homogeneous and bool((task.cost == task.cost[0]).all())

        def net(clocks: int, outputs: int, bias: float, groups: Tensor | None = None) -> CellClockNet:
            return CellClockNet(
                m, clocks, hidden=hidden, outputs=outputs, bias=bias, generator=generator, groups=groups
            )

        def decisions(seen: Neighbourhood) -> CellClockNet:
            return net(choices, seen.width, -1.0, self.view.groups() if alike and seen.moves_along else None)

        self.actor, self.critic = decisions(self.view), net(1, 1, 0.0)
        self.clocked_actor, self.clocked_critic = decisions(self.near), net(choices + 1, 1, 0.0)
        actor_loss.allocate((m, choices, self.view.width), device)
        self.actor_loss = actor_loss
        self.discount, self.safe = discount, 1.0 - task.safe_cost / task.reward
        cost = torch.as_tensor(task.cost / task.reward, dtype=torch.float32, device=device)
        self.register_buffer("cost", pad(cost, (0, 1)))
        self.register_buffer("clocks", torch.arange(choices, device=device).unsqueeze(-1))
        self.register_buffer("gain_scale", torch.ones(2, choices, device=device))

    def forward(self, cells: Tensor, on: Tensor, blend: float) -> dict[str, Tensor]:
        """The losses, each under the name of the net that it trains.

        Args:
            cells: int64 `[T+3, B]`, paths: the located cell, then the cells sensed next, M once outside.
            on: bool `[M, T+1, K]`, the sensors that the replayed policy switches on, as the actor's outputs.
            blend: λ of the gain.
        """
        clocked = self.clocked_critic().squeeze(-1)
        # U(x, T+1) holds r - D for certain; the net learns the rest.
        clocked = torch.cat([clocked[:, :-1], clocked[:, -1:] + self.safe], dim=1)
        advantage = pad(clocked_advantage(clocked.detach()), (0, 1))
        return self._clocked(cells, clocked, advantage) | self._own(cells, on, advantage, blend)

    def _clocked(self, cells: Tensor, clocked: Tensor, advantage: Tensor) -> dict[str, Tensor]:
        """From the first move of each path, at every clock: the position is revealed after every action."""
        near, known = self.near, pad(clocked.detach(), (0, 0, 0, 1))
        m, k = near.cells.shape
        start, end = cells[0], cells[1]
        logits = self.clocked_actor()
        moves = total((end < m).float(), start * k + near.index(start, end), m * k).view(m, 1, k)
        stays, visits = moves.sum(-1), torch.bincount(start, minlength=m).unsqueeze(-1)
        gain = moves * sensing_gain(advantage[:, near.cells].transpose(0, 1), reward=1.0, discount=self.discount)
        chosen = logits.detach() > 0
        spent = stays * (chosen * self.cost[near.cells].unsqueeze(1)).sum(-1)
        following = self.discount * torch.bmm(moves, known[near.cells]).squeeze(1)
        free = following[:, 1:] + (gain * chosen).sum(-1) - spent
        target = torch.cat([free, following[:, :1] + self.safe * stays], dim=1) / visits.clamp(min=1)
        error = visits * (clocked - target).square()
        plus, minus = gain.clamp(min=0), gain.clamp(max=0).neg()
        loss = decision_loss(logits, plus, minus, stays.unsqueeze(-1) * self.cost[near.cells].unsqueeze(1))
        return {
            "clocked_actor": self._balanced(0, loss, stays, plus + minus),
            "clocked_critic": error.sum() / cells.shape[1],
        }

    def _own(self, cells: Tensor, on: Tensor, advantage: Tensor, blend: float) -> dict[str, Tensor]:
        """From whole paths: the policy's chain is followed from their first cell until it detects or is forced."""
        view, discount = self.view, self.discount
        m, choices, k = on.shape
        start, moves, end = cells[0], cells[1:], cells[1:-1]
        logits, value = self.actor(), self.critic().view(m)
        row = start * choices + self.clocks
        entry = row * k + view.index(start, end)
        hits, inside = look(on, entry) & (end < m), moves < m
        located = look(pad(value.detach(), (0, 1)), moves)
        spent = look((on * self.cost[view.cells].unsqueeze(1)).sum(-1), row)
        returns = chain_returns(hits, inside, spent, located, reward=1.0, safe_cost=1.0 - self.safe, discount=discount)
        clocked = look(advantage, self.clocks * (m + 1) + end)
        gain = sensing_gain(clocked, located[:-1] - returns[1:], reward=1.0, discount=discount, blend=blend)
        alive = inside[:-1].clone()
        for n in range(1, choices):
            alive[n] &= alive[n - 1] & ~hits[n - 1]
        arrivals = total(alive.float(), row, m * choices).view(m, choices)
        price = arrivals.unsqueeze(-1) * self.cost[view.cells].unsqueeze(1)
        credit = SensorCredit(entry, gain * alive, arrivals, price)
        loss = self.actor_loss(logits, credit)
        visits = torch.bincount(start, minlength=m)
        error = visits * (value - total(returns[0], start, m) / visits.clamp(min=1)).square()
        return {
            "actor": self._balanced(1, loss, arrivals, credit.plus + credit.minus),
            "critic": error.sum() / cells.shape[1],
        }

    def _balanced(self, which: int, loss: Tensor, arrivals: Tensor, gains: Tensor) -> Tensor:
        """Sum of a loss, each clock by its own number of rows and its running mean gain, so that rare clocks count."""
        count = arrivals.expand(-1, loss.shape[1]).sum(0)
        mean = gains.sum((0, 2)) / count.clamp(min=1)
        self.gain_scale[which].lerp_(mean, _GAIN_SCALE_RATE)
        weight = 1.0 / (count.clamp(min=_FEWEST_ROWS) * self.gain_scale[which].clamp(min=_LEAST_GAIN))
        return (loss.sum((0, 2)) * weight).sum()
