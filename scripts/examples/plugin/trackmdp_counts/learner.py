"""The learner: counts of sensed moves, and the sets that pay if nothing is observed meanwhile."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from scipy import sparse
from tensordict import TensorDictBase

from trackmdp.policies.policy import Policy
from trackmdp.sensing.task import Task

if TYPE_CHECKING:
    from trackmdp_counts import CountsConfig


class Counts:
    """Collects with all sensors on; `actor` senses j after n misses where P̂^(n+1)[x, j] · r > c_j (FCR)."""

    def __init__(
        self, task: Task, cfg: CountsConfig, *, iterations: int, seed: int, device: torch.device
    ) -> None:
        self.task, self.cfg, self.iterations, self.device = task, cfg, iterations, device
        self.policy, self.actor = Policy.all_on(task), Policy.none(task)
        # Column M counts the exits.
        self.counts = sparse.csr_array((task.num_cells, task.num_cells + 1))

    def step(self, batch: TensorDictBase | None) -> dict[str, float]:
        """Count the moves of `batch` `[B, time]`, each from one located cell to the next, and decide anew."""
        if batch is not None:
            start, end = batch["last_cell"].flatten(), batch["next", "last_cell"].flatten()
            end = torch.where(batch["next", "terminated"].flatten(), self.task.num_cells, end)
            move = (np.ones(len(start)), (start.cpu().numpy(), end.cpu().numpy()))
            self.counts = sparse.csr_array(
                self.counts + sparse.coo_array(move, shape=self.counts.shape)
            )
        self.actor = Policy(self.task, self._sets())
        return {"moves": float(self.counts.sum())}

    def _sets(self) -> sparse.csr_array:
        """`[M (t_max + 1), M]`, row x (t_max + 1) + n: the cells worth sensing n misses after x."""
        m, choices = self.task.num_cells, self.task.num_choices
        total = self.counts.sum(axis=1) + self.cfg.prior
        kernel = sparse.csr_array(sparse.diags_array(1 / total) @ self.counts[:, :m])
        predicted, layers = kernel, []
        for n in range(choices):
            entry = predicted.tocoo()
            pays = entry.data * self.task.reward > self.task.cost[entry.col]
            layers.append((entry.row[pays] * choices + n, entry.col[pays]))
            predicted = predicted @ kernel
        rows, cells = (np.concatenate(part) for part in zip(*layers, strict=True))
        return sparse.csr_array(
            (np.ones(len(rows), dtype=bool), (rows, cells)), shape=(m * choices, m)
        )

    def state_dict(self) -> dict[str, Any]:
        """The counts, which are all that has been learned."""
        entry = self.counts.tocoo()
        return {
            "at": torch.as_tensor(np.stack([entry.row, entry.col])),
            "count": torch.as_tensor(entry.data),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from `state_dict`, with the policy of that time."""
        # `cpu`: a checkpoint is read to the learner's device.
        count, at = (state[name].cpu().numpy() for name in ("count", "at"))
        self.counts = sparse.csr_array((count, tuple(at)), shape=self.counts.shape)
        self.actor = Policy(self.task, self._sets())
