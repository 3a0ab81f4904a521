"""From a Track-MDP state to features: a linear layer that never multiplies by the zeros of a one-hot."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from trackmdp.world.model import Task

_PAIRS = 2**16  # of cells, once for each class of keys, whose displacements are kept; 16 x 16 cells have as many


class StateEncoder(nn.Module):
    """`[..., hidden]` features of (last_cell, steps_since_detection, action_history), and of `key` where there is one.

    Equal to a linear layer on the one-hot cell, the one-hot n, their product and the history bits, followed by ReLU.
    Embeddings stand for the one-hots, and the history is multiplied only where n > 0 (most rows have none). What a key
    shares with others (`KeySpace.contexts`), and the key, have each an embedding of the product with n: seldom seen
    keys are known by their cell and by their displacement or mode.
    """

    def __init__(self, task: Task, hidden: int, *, scale: float = 0.1, history_scale: float = 0.1) -> None:
        super().__init__()
        self.stages = task.t_max + 2
        self.cell = nn.Embedding(task.num_cells, hidden)
        self.stage = nn.Embedding(self.stages, hidden)
        self.cell_and_stage = nn.Embedding(task.num_cells * self.stages, hidden)
        self.history = nn.Linear(task.num_choices * task.num_sensors, hidden)
        self.keys = task.keys
        # The first context is of all keys alike, as is `stage`.
        counts = [count for _, count in task.keys.contexts(torch.zeros(1))[1:]] if task.keyed else []
        self.known = nn.ModuleList(nn.Embedding(count * self.stages, hidden) for count in counts)
        for table in (self.cell, self.stage, self.cell_and_stage, *self.known):
            nn.init.normal_(table.weight, std=scale)
        nn.init.normal_(self.history.weight, std=history_scale)
        nn.init.zeros_(self.history.bias)

    def forward(
        self, last_cell: Tensor, steps_since_detection: Tensor, action_history: Tensor, key: Tensor | None = None
    ) -> Tensor:
        """Features of a batch of any shape `[...]`; `action_history` is `[..., t_max+1, K]`."""
        shape = last_cell.shape
        cell, n = last_cell.reshape(-1), steps_since_detection.reshape(-1)
        features = self.cell(cell) + self.stage(n) + self.cell_and_stage(cell * self.stages + n)
        if key is not None:
            contexts = self.keys.contexts(key.reshape(-1))[1:]
            for table, (context, _) in zip(self.known, contexts, strict=True):
                features = features + table(context * self.stages + n)
        missed = n.nonzero().squeeze(-1)
        bits = action_history.reshape(len(cell), -1)[missed].to(features.dtype)
        features = features.index_add(0, missed, bits @ self.history.weight.T) + self.history.bias
        return torch.relu(features).reshape(*shape, -1)


class StateNetwork(nn.Module):
    """A `StateEncoder` with a linear head on top."""

    def __init__(self, task: Task, hidden: int, head: nn.Linear) -> None:
        super().__init__()
        self.encoder, self.head = StateEncoder(task, hidden), head

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
        # Sensors with footprints stand at no cell: each has a number of its own, whatever the cell.
        self._whole = task.window is None and task.coverage is None
        self.classes, self.stages = task.keys.num_classes, task.t_max + 2
        self.table = nn.Parameter(torch.zeros(self.classes * self.stages, places if self._whole else task.num_sensors))
        # Displacements (row, column) from (1 - rows, 1 - columns) to (rows - 1, columns - 1), row by row; (0, 0) is the
        # one in the middle. On 3 x 3, side 5, from cell 4 (code 6) to cell 5 (code 7): 7 - 6 + 12, right of the middle.
        cell = torch.arange(task.num_cells if self._whole else 0)
        code = cell // task.columns * side + cell % task.columns
        # On a small grid the places of all pairs of cells are kept, so that a state looks up one row of M numbers; on a
        # large one, where M² is more than a batch has, each state's places are worked out.
        few = self._whole and self.classes * len(code) ** 2 <= _PAIRS
        kept = code - code.unsqueeze(-1) + places // 2 if few else None
        self.register_buffer("_index", kept, persistent=False)
        self.register_buffer("_code", code if self._whole and kept is None else None, persistent=False)

    def forward(self, last_cell: Tensor, steps_since_detection: Tensor, key: Tensor | None = None) -> Tensor:
        """`[..., K]` of a batch of any shape `[...]`."""
        row = steps_since_detection if key is None else key % self.classes * self.stages + steps_since_detection
        if self._index is not None:
            m = len(self._index)
            rows = self.table[:, self._index].view(-1, m)
            return nn.functional.embedding(row * m + last_cell, rows)
        if self._code is None:
            return nn.functional.embedding(row, self.table)
        places = self.table.shape[1]
        middle = row * places + places // 2 - self._code[last_cell]
        return self.table.view(-1)[middle.unsqueeze(-1) + self._code]
