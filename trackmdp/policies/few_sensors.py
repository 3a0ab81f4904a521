"""A distribution over sets of at most B sensors: independent sensors, given that no more are on (theory.md#budgets).

With the odds w_j = e^(z_j) a set A of at most B sensors has the probability

    prod of w_j over A  /  sum over k = 0 ... B of e_k(w),

e_k the elementary symmetric polynomials: the coefficients of prod (1 + w_j x). They come from a tree of products of
polynomials, cut off after x^B, and sets are drawn from its root down: how many of a node's sensors lie on its left.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch import distributions as dist

_TINY = 1e-300


class FewSensors(dist.Distribution):
    """Sets of at most `budget` sensors; samples are `[..., K]` bool.

    Args:
        logits: `[..., K]` z.
        budget: B.
    """

    def __init__(self, logits: Tensor, budget: int) -> None:
        super().__init__(logits.shape[:-1], logits.shape[-1:], validate_args=False)
        self.logits, self.budget = logits, budget

    def _tree(self, logits: Tensor) -> tuple[list[Tensor], Tensor]:
        """Polynomials `[..., nodes, B + 1]` from the leaves to the root, and the largest logit `[..., 1]`.

        Odds are divided by the largest, so that none overflows: e_k is then e^(-k largest) times its own.
        """
        largest = logits.max(-1, keepdim=True).values.detach().double()
        odds = (logits.double() - largest).exp()
        count, width = odds.shape[-1], self.budget + 1
        leaves = odds.new_zeros(*odds.shape[:-1], 1 << (count - 1).bit_length(), width)
        leaves[..., 0] = 1.0
        if width > 1:
            padded = torch.nn.functional.pad(odds, (0, leaves.shape[-2] - count))
            leaves = torch.cat([leaves[..., :1], padded.unsqueeze(-1), leaves[..., 2:]], -1)
        levels = [leaves]
        while (now := levels[-1]).shape[-2] > 1:
            left, right = now[..., ::2, :], now[..., 1::2, :]
            parts = [
                torch.nn.functional.pad(left[..., k : k + 1] * right[..., : width - k], (k, 0))
                for k in range(width)
            ]
            levels.append(torch.stack(parts).sum(0))
        return levels, largest

    def _counts(self, logits: Tensor) -> tuple[list[Tensor], Tensor]:
        """The tree, and `[..., B + 1]` logarithms of e_k: of how many sensors are on, up to a constant."""
        levels, largest = self._tree(logits)
        known = levels[-1].squeeze(-2).clamp_min(_TINY).log()
        return levels, known + largest * torch.arange(self.budget + 1, device=logits.device)

    def _total(self, logits: Tensor) -> Tensor:
        """`[...]` logarithm of the sum over all sets."""
        return self._counts(logits)[1].logsumexp(-1)

    def sample(self, sample_shape: Sequence[int] = ()) -> Tensor:
        """A set."""
        shape = (*sample_shape, *self.logits.shape)
        with torch.no_grad():
            levels, counts = self._counts(self.logits.expand(shape))
            number = _drawn(counts.softmax(-1)).unsqueeze(-1)
            for tables in reversed(levels[:-1]):
                left, right = tables[..., ::2, :], tables[..., 1::2, :]
                rest = number.unsqueeze(-1) - torch.arange(self.budget + 1, device=counts.device)
                chances = left * right.gather(-1, rest.clamp_min(0)) * (rest >= 0)
                mine = _drawn(chances)
                number = torch.stack([mine, number - mine], -1).flatten(-2)
        return number[..., : shape[-1]] > 0

    def log_prob(self, value: Tensor) -> Tensor:
        """`[...]` log-probability of the set `value` `[..., K]`."""
        chosen = (self.logits * value).sum(-1)
        return (chosen.double() - self._total(self.logits)).to(self.logits.dtype)

    @property
    def mean(self) -> Tensor:
        """`[..., K]` probability that each sensor is on: the slope of the logarithm of the sum over all sets."""
        if not self.budget:
            return torch.zeros_like(self.logits)
        graph = torch.is_grad_enabled() and self.logits.requires_grad
        with torch.enable_grad():
            logits = self.logits if graph else self.logits.detach().requires_grad_()
            total = self._total(logits).sum()
            return torch.autograd.grad(total, logits, create_graph=graph)[0]

    def entropy(self) -> Tensor:
        """`[...]` log of the sum over all sets, less the mean of the chosen sensors' logits."""
        expected = (self.mean * self.logits).sum(-1)
        return self._total(self.logits).to(self.logits.dtype) - expected

    @property
    def mode(self) -> Tensor:
        """The most likely set: of the sensors with a positive logit those of the largest."""
        return greedy(self.logits, self.budget)

    deterministic_sample = mode


def greedy(value: Tensor, budget: int | None) -> Tensor:
    """`[..., K]` bool, the sensors of a `value` above 0, with a budget the best of them."""
    on = value > 0
    if budget is None or budget >= value.shape[-1]:
        return on
    best = torch.zeros_like(on).scatter_(-1, value.topk(budget, -1).indices, value=True)
    return on & best


def _drawn(chances: Tensor) -> Tensor:
    """`[...]` numbers drawn in proportion to `chances` `[..., N]`; one without any chance is never drawn."""
    sums = chances.cumsum(-1)
    draws = torch.rand(sums.shape[:-1], dtype=sums.dtype, device=sums.device) * sums[..., -1]
    return (sums <= draws.unsqueeze(-1)).sum(-1).clamp_max(sums.shape[-1] - 1)
