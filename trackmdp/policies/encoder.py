"""The encoder of a state, on which all networks over states stand, and the numbers per sensor that all cells share.

The encoder is a linear layer that never multiplies by the zeros of a one-hot.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from trackmdp.sensing.task import Task

_PAIRS = 2**16  # of cells, with their displacements kept in memory; 16 x 16 cells have as many


class StateEncoder(nn.Module):
    """`[..., hidden]` features of (last_cell, steps_since_detection, action_history), and of `key` where there is one.

    Equal to a linear layer on the one-hot cell, the one-hot n, their product and the history bits, followed by ReLU.
    Sums of rows of one table stand for the one-hots, and the history is multiplied only where n > 0 (most rows have
    none). The contexts that a key shares with others (`KeySpace.contexts`), and the key, have each rows of the product
    with n: seldom seen keys are known by their cell and by their displacement or mode.
    """

    def __init__(
        self, task: Task, hidden: int, *, scale: float = 0.1, history_scale: float = 0.1
    ) -> None:
        super().__init__()
        self.stages, self.keys = task.t_max + 2, task.keys
        self._parts = {
            "cell": task.num_cells,
            "stage": self.stages,
            "cell_and_stage": task.num_cells * self.stages,
        }
        # The first context is of all keys alike, as is `stage`.
        contexts = task.keys.contexts(torch.zeros(1))[1:] if task.keyed else []
        for k, (_, count) in enumerate(contexts):
            self._parts[f"known.{k}"] = count * self.stages
        # One table for all: one lookup adds the rows up, which takes a fifth of the time of one after the other.
        self.table = nn.Parameter(scale * torch.randn(sum(self._parts.values()), hidden))
        counts = torch.tensor([0, *self._parts.values()])
        self.offset = nn.Buffer(counts[:-1].cumsum(0), persistent=False)
        self.history = nn.Linear(task.num_choices * task.num_sensors, hidden)
        nn.init.normal_(self.history.weight, std=history_scale)
        nn.init.zeros_(self.history.bias)
        # Files hold the parts by their names: a run of another t_max or memory takes those that fit (`init_from`).
        self.register_state_dict_post_hook(_split)
        self.register_load_state_dict_pre_hook(_joined)

    def forward(
        self,
        last_cell: Tensor,
        steps_since_detection: Tensor,
        action_history: Tensor,
        key: Tensor | None = None,
    ) -> Tensor:
        """Features of a batch of any shape `[...]`; `action_history` is `[..., t_max+1, K]`."""
        shape = last_cell.shape
        cell, n = last_cell.reshape(-1), steps_since_detection.reshape(-1)
        rows = [cell, n, cell * self.stages + n]
        if key is not None:
            contexts = self.keys.contexts(key.reshape(-1))[1:]
            rows += [context * self.stages + n for context, _ in contexts]
        index = torch.stack(rows, -1) + self.offset
        features = nn.functional.embedding_bag(index, self.table, mode="sum")
        missed = n.nonzero().squeeze(-1)
        bits = action_history.reshape(len(cell), -1)[missed].to(features.dtype)
        features.index_add_(0, missed, bits @ self.history.weight.T)
        features += self.history.bias
        return features.relu_().reshape(*shape, -1)


def _split(encoder: StateEncoder, state: dict[str, Any], prefix: str, *_: Any) -> None:
    """Name the parts of the table in a state dict, views of it."""
    parts = state.pop(f"{prefix}table").split(list(encoder._parts.values()))
    for name, part in zip(encoder._parts, parts, strict=True):
        state[f"{prefix}{name}"] = part


def _joined(encoder: StateEncoder, state: dict[str, Any], prefix: str, *_: Any) -> None:
    """Join the parts of a state dict that has all of them."""
    if all(f"{prefix}{name}" in state for name in encoder._parts):
        parts = [state.pop(f"{prefix}{name}") for name in encoder._parts]
        state[f"{prefix}table"] = torch.cat(parts)


class StateNetwork(nn.Module):
    """A `StateEncoder` with a linear head on top."""

    def __init__(
        self, task: Task, hidden: int, head: nn.Linear, targets: Sequence[int] = ()
    ) -> None:
        super().__init__()
        self.encoder = of_kinds(partial(StateEncoder, task, hidden), targets)
        self.head = head

    def forward(self, *state: Tensor) -> Tensor:
        """`[..., head.out_features]` of a batch of states of shape `[...]`, the arguments those of the encoder."""
        return self.head(self.encoder(*state))


class RelativeBias(nn.Module):
    """A number per sensor by n and by where the sensor stands, as seen from the last located cell; zero at first.

    It is shared by all cells: that sensors far away are of no use is learned once, not once per cell. (The name is that
    of the relative position bias of Shaw et al. 2018.) Where a policy knows more than the cell, each class of keys has
    numbers of its own: that a target with this heading goes there is learned once as well.

    With `grid.window` the K sensors of the window are the displacements, and the table is `[C (t_max+2), K]`. Without
    one there are (2 rows - 1)(2 columns - 1) displacements, of which each cell sees M.
    """

    _code: Tensor | None
    _index: Tensor | None

    def __init__(self, task: Task) -> None:
        super().__init__()
        side, places = 2 * task.columns - 1, (2 * task.rows - 1) * (2 * task.columns - 1)
        # Sensors with footprints stand at no cell: each has a number of its own, the same for every cell.
        whole = task.numbered is None and task.coverage is None
        self.classes, self.stages = task.keys.num_classes, task.t_max + 2
        self.table = nn.Parameter(
            torch.zeros(self.classes * self.stages, places if whole else task.num_sensors)
        )
        # Displacements (row, column) from (1 - rows, 1 - columns) to (rows - 1, columns - 1), row by row; (0, 0) is the
        # one in the middle. On 3 x 3, side 5, from cell 4 (code 6) to cell 5 (code 7): 7 - 6 + 12, right of the middle.
        cell = torch.arange(task.num_cells if whole else 0)
        code = cell // task.columns * side + cell % task.columns
        # On a small grid the places of all pairs of cells are kept: where a batch has more states than there are rows
        # (class, n, cell), all rows are written out, and a state looks up one of them.
        few = whole and len(code) ** 2 <= _PAIRS
        kept = code - code.unsqueeze(-1) + places // 2 if few else None
        self.register_buffer("_index", kept, persistent=False)
        self.register_buffer("_code", code if whole else None, persistent=False)

    def forward(
        self, last_cell: Tensor, steps_since_detection: Tensor, key: Tensor | None = None
    ) -> Tensor:
        """`[..., K]` of a batch of any shape `[...]`."""
        row = (
            steps_since_detection
            if key is None
            else key % self.classes * self.stages + steps_since_detection
        )
        if self._code is None:
            return nn.functional.embedding(row, self.table)
        m = len(self._code)
        if self._index is not None and len(self.table) * m <= row.numel():
            rows = self.table[:, self._index].view(-1, m)
            return nn.functional.embedding(row * m + last_cell, rows)
        places = self.table.shape[1]
        middle = row * places + places // 2 - self._code[last_cell]
        return self.table.view(-1)[middle.unsqueeze(-1) + self._code]


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
