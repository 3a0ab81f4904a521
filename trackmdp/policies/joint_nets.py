"""Parts of networks over what is known of several targets: sums over the targets of the parts for a single one.

Targets that are of one kind share their weights, and one that has left the grid adds nothing. Gains of a sensor add up
over targets as well (theory.md#several-targets), so that a logit that is a sum is of the form of the merged policy.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import torch
from torch import Tensor, nn


class OverTargets(nn.Module):
    """`[..., F]` sum over the targets in the grid of what the part of their kind makes of each.

    Args:
        parts: a module for each kind, of (last_cell, steps_since_detection) and, where it takes it, action_history.
        targets: kind of each target, K numbers from 0.
    """

    def __init__(self, parts: Iterable[nn.Module], targets: Sequence[int]) -> None:
        super().__init__()
        self.parts = nn.ModuleList(parts)
        self._of_kind = [
            [place for place, each in enumerate(targets) if each == kind]
            for kind in range(len(self.parts))
        ]

    def forward(self, last_cell: Tensor, steps_since_detection: Tensor, *others: Tensor) -> Tensor:
        """Of a batch of any shape `[...]`, all `[..., K]` but the history `[..., t_max+1, S]`; `present` comes last."""
        *history, present = others
        total: Tensor | None = None
        for part, which in zip(self.parts, self._of_kind, strict=True):
            n = steps_since_detection[..., which]
            own = part(last_cell[..., which], n, *(_since(each, n) for each in history))
            summed = (own * present[..., which].unsqueeze(-1)).sum(-2)
            total = summed if total is None else total + summed
        assert total is not None
        return total


def of_kinds(make: Callable[[], nn.Module], targets: Sequence[int]) -> nn.Module:
    """A part for a single target; of several, of the kinds `targets`, one for each kind, added up."""
    return OverTargets((make() for _ in set(targets)), targets) if targets else make()


def _since(history: Tensor, n: Tensor) -> Tensor:
    """`[..., K, t_max+1, S]`, the actions `[..., t_max+1, S]` since the last detection of each target, `[..., K]`."""
    slots = torch.arange(history.shape[-2], device=n.device)
    return history.unsqueeze(-3) & (slots < n.unsqueeze(-1)).unsqueeze(-1)


def last_clock(steps_since_detection: Tensor, targets: Sequence[int]) -> Tensor:
    """`[...]` n, of several targets the largest, by which the safe action is forced."""
    return steps_since_detection.amax(-1) if targets else steps_since_detection
