"""The policy's own plans followed on fully sensed paths: where they lead, and the gain of a report at each step."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pad

from trackmdp.algos.gains import Credit, chain_returns, gather, scatter_add, sensing_gain
from trackmdp.algos.path_replay import Replay
from trackmdp.sensing.task import Task
from trackmdp.sensing.windows import Window


@dataclass(frozen=True)
class Replayed:
    """The policy's own plans followed on every path, as tables for the actor's loss.

    Attributes:
        row: `[T+1, B]`, the place in `[M, T+1]` of the path's first cell.
        entry: `[T+1, B]`, the place in `[M, T+1, K]` of the sensor the target moved to.
        alive: `[T+1, B]`, probability that the target was not yet located where it is in the grid, else 0.
        gain: `[T+1, B]`, of a report there, times `alive`.
        target: `[M, 1]`, mean return of the paths from each cell, the critic's target; where the safe action may miss
            `[M, 2]`, the second of paths with it at the first step.
    """

    row: Tensor
    entry: Tensor
    alive: Tensor
    gain: Tensor
    target: Tensor


@dataclass(frozen=True)
class OwnPlans:
    """Plans from each key, followed until they detect or are forced.

    Attributes:
        task: its keys.
        view: the cells in which plans may report the target.
        clocks: `[T+1, 1]`, 0 ... T.
        credit: the discount, and the safe action.
    """

    task: Task
    view: Window
    clocks: Tensor
    credit: Credit

    def followed(
        self,
        replay: Replay | None,
        cells: Tensor,
        own: Tensor,
        policy: tuple[Tensor, Tensor],
        advantage: Tensor,
        value: Tensor,
        blend: float,
    ) -> Replayed:
        """From whole paths: the policy's chain is followed from their first cell until it detects or is forced.

        Args:
            replay: of a policy that remembers detections.
            cells: the paths.
            own: `[T+3, B]`, the key that the policy has at first, and those of a first detection at each later step.
            policy: of each set the probability of a report in each cell in view, and its price.
            advantage: of detecting, the position being revealed after every action.
            value: V.
            blend: λ.
        """
        (found, prices), m = policy, self.task.num_keys
        # [B], [T + 2, B] and [T + 1, B]: the free choices are for the first T + 1 moves, the last one is the forced
        # step.
        start, moves = own[0], cells[1 : len(self.clocks) + 2]
        end = moves[:-1]
        row, entry, seen = self._places(start, end)
        # [T + 1, B], the probability of a report; 0 or 1 with sensors that never miss.
        reports, inside = gather(found, entry) * seen.float(), moves < m
        # Set costs are computed once per (x, n) and looked up by the paths, however many there are.
        spent = gather(prices, row)
        located = self._located(replay, cells, own, prices, value[:, 0])
        returns = self._returns((reports, inside, spent, located), moves[-1], value)
        # advantage is [T + 1, M + 1]: entry (n, y) is n (M + 1) + y.
        clocked = gather(advantage, self.clocks * (m + 1) + end)
        # V(y) - G_{n+1}: located at y now, against the plan's return on the rest of this very path. The target's true
        # cell is known because it was sensed, not from the simulator.
        after = located[:-1] - returns[1:]
        gain = sensing_gain(clocked, after, discount=self.credit.discount, blend=blend)
        alive = _alive(inside, reports)
        firsts = [returns[0]]
        if self.credit.safe_detection is not None:
            # No set is before it, so that it is the first step of a path.
            steps = (reports[:0], inside[:1], spent[:0], located[:1])
            firsts.append(self._returns(steps, moves[0], value)[0])
        # Cells without a path get the target 0, and with no visits no weight in the critic's loss.
        totals = torch.stack([scatter_add(first, start, m) for first in firsts], dim=1)
        target = totals / torch.bincount(start, minlength=m).clamp(min=1).unsqueeze(-1)
        return Replayed(row, entry, alive, gain * alive * seen, target)

    def _places(self, start: Tensor, end: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """`[T+1, B]` each: row and entry as in `Replayed`, and whether a sensor of the entry may report."""
        located_in, there = self.task.keys.cell(start), self.task.keys.cell(end)
        # clocks [T + 1, 1] broadcasts over paths. With M = K = 4 and T = 1: located in 3, n = 1 is row 7, and the
        # target moving to 2 makes entry 7 * 4 + 2 = 30.
        row = start * len(self.clocks) + self.clocks
        # Where the target has left the grid or the view, `entry` is some other sensor's.
        local, width = self.view.find(located_in, there), self.view.width
        return row, row * width + local.clamp_max(width - 1), local < width

    def _located(
        self, replay: Replay | None, cells: Tensor, own: Tensor, prices: Tensor, value: Tensor
    ) -> Tensor:
        """`[T+2, B]`, the value of a detection at each step."""
        if replay is None:
            return gather(pad(value, (0, 1)), own[1:])
        return replay.worth(
            cells,
            own,
            prices,
            value,
            safe_cost=self.credit.safe_cost,
            discount=self.credit.discount,
        )

    def _returns(self, steps: tuple[Tensor, ...], end: Tensor, value: Tensor) -> Tensor:
        """The returns of chains (`chain_returns`) that end with the safe action, the target then in `end` `[B]`."""
        repeated = None
        if self.credit.safe_detection is not None:
            # p_s of these cells, and L, the value there if the safe action misses.
            repeated = self.credit.safe_detection[end], pad(value[:, 1], (0, 1))[end]
        return chain_returns(
            *steps,
            safe_cost=self.credit.safe_cost,
            discount=self.credit.discount,
            repeated=repeated,
        )


def _alive(inside: Tensor, reports: Tensor) -> Tensor:
    """`alive` of `Replayed`."""
    # Clock n is reached if no earlier set of the plan reported; other rows are not states of this policy. The move has
    # to stay in the grid, too: an exit step earns and costs nothing.
    alive = inside[:-1].float()
    for n in range(1, len(alive)):
        alive[n] *= alive[n - 1] * (1.0 - reports[n - 1])
    return alive
