"""Losses of the clocked actor and critic, from single moves: the position is revealed after every action."""

from __future__ import annotations

import torch
from torch import Tensor

from trackmdp.algos.actor_loss import decision_loss
from trackmdp.algos.gains import Credit, scatter_add, sensing_gain
from trackmdp.algos.in_view import SensorsInView
from trackmdp.policies.cell_clock import CellClockNet
from trackmdp.sensing.task import Task
from trackmdp.sensing.windows import Window


class ClockedLoss:
    """The losses of each clock, from moves that are counted by their two ends.

    Args:
        task: its keys, and its window.
        near: the cells that one move may lead to.
        sensors: of these cells.
        actor: the clocked actor.
        credit: its discount, and the safe action.
        reach: rows and columns that the target moves in one step, at most.
    """

    def __init__(
        self,
        task: Task,
        near: Window,
        sensors: SensorsInView,
        actor: CellClockNet,
        credit: Credit,
        reach: int,
    ) -> None:
        self._keys, self._near, self._sensors, self._actor = task.keys, near, sensors, actor
        self._credit, self._discount = credit, credit.discount
        # [M, C], the cells that are near each located one.
        self._near_cells = near.cells.repeat_interleave(task.keys.num_classes, dim=0)
        limited = task.numbered is not None and task.numbered < reach
        self._choosable = Window.of(task, near.cells.device) if limited else None

    def first_gains(self, end: Tensor, advantage: Tensor) -> tuple[Tensor, Tensor]:
        """How many paths stay in the grid for a move, and the sum of the gains of sensing there, `[T+1]`."""
        # The gain depends on the end y and the clock alone, so moves are counted by y: [T + 1, M] @ [M].
        arrived = torch.bincount(end, minlength=advantage.shape[1])[:-1].float()
        gain = sensing_gain(advantage[:, :-1], discount=self._discount)
        return arrived.sum(), gain.abs() @ arrived

    def of(
        self, moves: Tensor, rows: slice, advantage: Tensor, known: Tensor
    ) -> tuple[Tensor, Tensor]:
        """From the moves `[2, B]` out of the cells `rows`, at every clock: the position is revealed after every action.

        Returns:
            The clocked actor's losses summed per clock, `[T+1]`, and the clocked critic's targets `[rows, T+2]`.
        """
        nearby, logits = self._near_cells[rows], self._actor(rows)
        k, h = nearby.shape[1], self._keys.modes
        ends = self._ends(nearby, rows)
        moved, visits = self._counted(moves, rows, len(nearby))
        stays = moved.sum(-1)
        # advantage[:, ends] is [T + 1, x, C H]: transposed to the layout [x, T + 1, C H].
        gain = moved * sensing_gain(advantage[:, ends].transpose(0, 1), discount=self._discount)
        # All moves to a key have the same gain, so its sign makes it a part of its cell's G⁺ or G⁻.
        plus, minus = (
            part.unflatten(-1, (k, h)).sum(-1)
            for part in (gain.clamp(min=0), gain.clamp(max=0).neg())
        )
        chosen, cost = logits.detach() > 0, self._sensors.prices[rows].unsqueeze(1)
        if self._choosable is not None:
            # Sensors outside the window cannot be chosen: they neither gain nor cost, nor are they learned about.
            allowed = self._allowed(self._choosable, rows).unsqueeze(1)
            chosen, cost = chosen & allowed, cost * allowed
            plus, minus = plus * allowed, minus * allowed
        # Each sensor on adds its gain, which turns gamma U(j, n + 1) into r + gamma U(j, 0), and takes its cost away.
        found = ((plus - minus) * self._sensors.reports(chosen, rows)).sum(-1)
        sensed = found, stays * (chosen * cost).sum(-1)
        target = self._returns(moved, known[ends], ends, sensed) / visits.clamp(min=1)
        # The price is c for every move that stays in the grid.
        plus, minus = (self._sensors.gains(each, chosen, rows) for each in (plus, minus))
        loss = decision_loss(logits, plus, minus, stays.unsqueeze(-1) * cost)
        return loss.sum((0, 2)), target

    def _ends(self, cells: Tensor, rows: slice) -> Tensor:
        """`[x, C H]`, the keys after moves from the keys `rows` to `cells` `[x, C]`, in H modes; M outside."""
        keys, device = self._keys, cells.device
        start = torch.arange(keys.num_keys, device=device)[rows, None, None]
        modes = torch.arange(keys.modes, device=device)
        ends: Tensor = keys.next(start, 0, cells.unsqueeze(-1), modes)
        return ends.flatten(1).clamp_max(keys.num_keys)

    def _counted(self, moves: Tensor, rows: slice, count: int) -> tuple[Tensor, Tensor]:
        """`[x, 1, C H]`, the moves from each of `count` keys by their end, and `[x, 1]` all, exits included.

        Their quotient is the empirical kernel P_xj.
        """
        k, h, m = self._near.width, self._keys.modes, self._keys.num_keys
        (start, end), first = moves, rows.start
        near = self._near.index(self._keys.cell(start), self._keys.cell(end))
        # Flat place in [rows, C H] of a move: with C = 9, H = 1, from cell 7 to its local cell 5 is 7 * 9 + 5 = 68;
        # where the slice begins at cell 4, 68 - 36 = 32. Exits have weight 0, wherever `index` puts them.
        place = (start * k + near - first * k) * h + end % h
        moved = scatter_add((end < m).float(), place, count * k * h).view(count, 1, k * h)
        return moved, torch.bincount(start - first, minlength=count).unsqueeze(-1)

    def _returns(
        self, moved: Tensor, known: Tensor, ends: Tensor, sensed: tuple[Tensor, Tensor]
    ) -> Tensor:
        """`[x, T+2]`, sums over the moves from x of r, gamma U and prices; `sensed`: gains and prices, `[x, T+1]`.

        U(x, n) = sum_j P_xj gamma U(j, n + 1), if nothing is sensed. At n = T + 1 all are located: r - D + gamma U(j,
        0).
        """
        # [x, 1, C H] @ [x, C H, T + 2]: gamma sum_j moved_j U(j, n), for all n by one product.
        following, stays = self._discount * torch.bmm(moved, known).squeeze(1), moved.sum(-1)
        if self._credit.safe_detection is None:
            forced = following[:, :1] + (1.0 - self._credit.safe_cost) * stays
        else:  # a missed target goes on at n = T + 1
            located = moved.squeeze(1) * self._credit.safe_detection[ends]
            after = located * (1.0 + self._discount * known[..., 0])
            missed = (moved.squeeze(1) - located) * self._discount * known[..., -1]
            forced = (after + missed).sum(-1, keepdim=True) - self._credit.safe_cost * stays
        found, spent = sensed
        return torch.cat([following[:, 1:] + found - spent, forced], dim=1)

    def _allowed(self, window: Window, rows: slice) -> Tensor:
        """`[rows, K]` bool, which of the sensors near the cells `rows` the task's window lets choose."""
        nearby = self._near_cells[rows]
        start = torch.arange(self._keys.num_keys, device=nearby.device)[rows]
        start = self._keys.cell(start)[:, None].expand_as(nearby)
        return window.contains(start, nearby)
