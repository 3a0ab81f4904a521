"""The gain of switching one sensor on (theory.md#gains).

The motion is exogenous, so on a fully sensed path every policy can be replayed, its misses included. At an info state
with n misses, the target moving to cell y next, the sensor of y gains the worth of a detection over a miss, no
other sensor gains anything, and each sensor that is on costs its c. Gains are gathered from and added up in tables over
(cell, clock, sensor).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pad

from trackmdp.sensing.task import Task


@dataclass(frozen=True)
class Credit:
    """The discount of returns, and the safe action in units of r.

    Attributes:
        discount: γ.
        safe_cost: D.
        forced: r - D; or about the sum of all forced steps until one locates.
        safe_detection: `[M + 1]` p_s of each key, 0 outside.
    """

    discount: float
    safe_cost: float
    forced: float
    safe_detection: Tensor

    @classmethod
    def of(cls, task: Task, discount: float, device: torch.device) -> Credit:
        """Known to the learner like the prices: it is the task's.

        Args:
            task: its safe action.
            discount: γ.
            device: of the probabilities.
        """
        cost, safe = task.safe_cost / task.reward, float(task.safe_detection.mean())
        forced = (safe - cost) / (1.0 - discount * (1.0 - safe))
        locates = torch.as_tensor(task.safe_detection, dtype=torch.float32, device=device)
        every = locates.repeat_interleave(task.keys.num_classes)
        return cls(discount, cost, forced, pad(every, (0, 1)))

    def gain(self, advantage: Tensor) -> Tensor:
        """The gain, in units of r, of having the target's sensor on, from the worth of a detection over a miss.

        That is (1-λ)(U(y,0) - U(y,n+1)) + λ(V(y) - G_{n+1}): at λ = 0 clocked, with optimistic values after a miss, at
        λ = 1 by the policy's own continuation, G_{n+1} being the return of its chain from n + 1 misses on, the target
        truly at y. Taking λ slowly from 0 to 1 leads past optima that no change of a single sensor improves.
        """
        return 1.0 + self.discount * advantage

    def returns(
        self,
        hits: Tensor,
        inside: Tensor,
        set_cost: Tensor,
        value: Tensor,
        end: Tensor,
        missed: Tensor,
    ) -> Tensor:
        """Return of a chain of sets from each of its steps on, along paths, the target undetected until then; r = 1.

        Backwards from the safe action: G_{T+1} = p_s(y)(r + γV(y)) + (1 - p_s(y))γL(y) - D, G_n = r + γV(y) - c(A_n)
        if y is in A_n, else γG_{n+1} - c(A_n), where y is the cell the target moves to at that step; 0 once the target
        has left. A sensor that may miss gives the mean of the two: no report is drawn, and none adds noise.

        Args:
            hits: `[T+1, B]`, whether A_n contains y, or the probability that the sensor there reports.
            inside: bool `[T+2, B]`, whether the target is in the grid after the move.
            set_cost: `[T+1, B]`, c(A_n), the cost of the sensors on.
            value: `[T+2, B]`, V(y).
            end: `[B]`, y at the safe action; M outside.
            missed: `[M]`, L, the value of the target being in y where the safe action comes next.

        Returns:
            `[T+2, B]`.
        """
        found = 1.0 + self.discount * value
        again = self.discount * pad(missed, (0, 1))[end]
        last = torch.lerp(again, found[-1], self.safe_detection[end])
        # The forced step has no set to pay for. Each G is 0 where the target has left by then, so that a
        # plan that misses until the exit has paid for its sets in the grid alone.
        returns = [(last - self.safe_cost) * inside[-1]]
        for n in reversed(range(len(hits))):
            after = self.discount * returns[-1]
            outcome = torch.lerp(after, found[n], hits[n].to(found.dtype)) - set_cost[n]
            returns.append(outcome * inside[n])
        return torch.stack(returns[::-1])


def clocked_advantage(clocked: Tensor) -> Tensor:
    """U(y,0) - U(y,n+1), `[T+1, M]`: worth of a detection in cell y after n misses over a miss.

    Args:
        clocked: `[M, T+2]`, U(y,n), the value when the position is revealed after every action but the clock runs on.
    """
    # Column 0 is U(y, 0), column n + 1 is the clock after one more miss: [M, T + 1], transposed.
    return (clocked[:, :1] - clocked[:, 1:]).T.contiguous()


def gather(table: Tensor, index: Tensor) -> Tensor:
    """`table.flatten()[index]`, the fastest way."""
    return table.reshape(-1).index_select(0, index.reshape(-1)).view(index.shape)


def scatter_add(values: Tensor, index: Tensor, length: int) -> Tensor:
    """`[length]`, the sums of the `values` that share an `index`."""
    return values.new_zeros(length).scatter_add_(0, index.reshape(-1), values.reshape(-1))
