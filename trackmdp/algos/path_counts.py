"""Path counts: learn policies that remember more than the cell, by counting on fully sensed paths."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from trackmdp.algos.learned_kernel import policy_tensors, tensors_policy
from trackmdp.config.path_counts import PathCountsConfig
from trackmdp.errors import UserError
from trackmdp.policies.policy import Policy, as_policy
from trackmdp.solvers.path_counts import plan_keys
from trackmdp.solvers.path_exchange import choose_plan
from trackmdp.world.model import Task
from trackmdp.world.tracks import Tracks

__all__ = ["PathCounts", "SensedPaths"]


class PathCounts:
    """Collects with all sensors on and plans anew after every batch, from all paths so far.

    Args:
        task: grid, rewards, costs and memory.
        cfg: weight of what keys share, discount and rounds.
        iterations: batches to come.
        seed: not read: nothing is drawn.
        device: where batches come from; paths and plans are on the CPU.
    """

    def __init__(
        self,
        task: Task,
        cfg: PathCountsConfig,
        *,
        iterations: int,
        seed: int,  # noqa: ARG002
        device: torch.device,
    ) -> None:
        if not (task.perfect and task.safe):
            raise UserError("algo=path_counts: with sensors that may miss, expected another algorithm")
        self.task, self.cfg, self.iterations, self.device = task, cfg, iterations, device
        self._paths = SensedPaths(task.num_cells)
        self.actor = Policy.none(task)
        self.policy = _AllSensors(task.num_sensors)

    def step(self, batch: TensorDictBase | None) -> dict[str, float]:
        """Take in one batch `[B, time]` and plan."""
        if batch is not None:
            self._paths.extend(batch)
        tracks, cfg = self._paths.tracks(), self.cfg
        if cfg.prior is None:
            found = choose_plan(self.task, tracks, judge=None, discount=cfg.gamma, rounds=cfg.rounds)
        else:
            found = plan_keys(self.task, tracks, prior=cfg.prior, discount=cfg.gamma, rounds=cfg.rounds)
        self.actor = as_policy(self.task, found.policy)
        moves = max(len(tracks.cells) - len(tracks), 1)
        return {
            "paths": float(len(tracks)),
            "keys_seen": float(found.seen),
            "reward_per_move": found.reward / moves,
            "rounds": float(found.rounds),
        }

    def state_dict(self) -> dict[str, Any]:
        """The paths and the plan; nothing is drawn."""
        return {"paths": self._paths.state_dict(), "actor": policy_tensors(self.actor)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a `state_dict`."""
        self._paths.load_state_dict(state["paths"])
        self.actor = Policy.none(self.task) if state["actor"] is None else tensors_policy(self.task, state["actor"])


class SensedPaths:
    """Whole paths put together from batches that were collected with all sensors on, each row continuing the last.

    Read is only what the tracker saw: where it located the target, and that it left. A step on which the target was
    missed (it left the window of the task) ends the path, and the next detection begins another.
    """

    def __init__(self, num_cells: int) -> None:
        self.num_cells = num_cells
        # [rows, time] each: the cell before the step, the cell after it (M once outside, -1 where missed), and whether
        # an episode ended with it.
        self._parts: dict[str, list[torch.Tensor]] = {"start": [], "end": [], "done": []}

    def extend(self, batch: TensorDictBase) -> None:
        """Add a collected batch `[B, time]` or `[workers, B, time]`."""
        batch = batch.reshape(-1, batch.shape[-1])
        after = batch["next"]
        exited = after["terminated"].squeeze(-1)
        located = after["steps_since_detection"] == 0
        end = torch.where(exited, self.num_cells, torch.where(located, after["last_cell"], -1))
        # Before a step the cell is known only where it was just located.
        start = torch.where(batch["steps_since_detection"] == 0, batch["last_cell"], -1)
        for name, part in (("start", start), ("end", end), ("done", after["done"].squeeze(-1))):
            self._parts[name].append(part.to("cpu", torch.int32))

    def tracks(self) -> Tracks:
        """All paths so far, those that still go on among them; they count as recordings that stop."""
        start, end, done = (torch.cat(parts, dim=1).numpy().astype(np.int64) for parts in self._parts.values())
        # A path goes on from one step to the next if the target was located in between, and rows were not exchanged
        # (collectors of several workers may).
        going = (done[:, :-1] == 0) & (end[:, :-1] == start[:, 1:]) & (start[:, :-1] >= 0) & (start[:, 1:] >= 0)
        begins = np.concatenate([np.ones((len(start), 1), dtype=bool), ~going], axis=1).ravel()
        start, end = start.ravel(), end.ravel()
        kept = start >= 0
        begin = np.flatnonzero(begins[kept])
        # Steps 3>4 4>M (exit) and 7>8 become the cells 3 4 M 7 8: the first cell of each path, then where it went.
        # A step that was missed, -1, is the last of its path, and is left out.
        cells = np.insert(end[kept], begin, start[kept][begin])
        path = np.cumsum(np.insert(np.zeros(int(kept.sum()), dtype=np.int64), begin, 1)) - 1
        exits = np.zeros(len(begin), dtype=bool)
        exits[path[cells == self.num_cells]] = True
        inside = (cells >= 0) & (cells < self.num_cells)
        lengths = np.bincount(path[inside], minlength=len(begin))
        return Tracks(cells[inside], np.concatenate([[0], np.cumsum(lengths)]), exits, np.arange(len(begin)))

    def state_dict(self) -> dict[str, Any]:
        """The steps of all batches, end to end."""
        return {name: torch.cat(parts, dim=1) for name, parts in self._parts.items() if parts}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a `state_dict`."""
        self._parts = {name: [state[name].cpu()] if name in state else [] for name in self._parts}


class _AllSensors(TensorDictModuleBase):
    """Every sensor that can be chosen is on."""

    in_keys: ClassVar = ["last_cell"]
    out_keys: ClassVar = ["action"]

    def __init__(self, sensors: int) -> None:
        super().__init__()
        self.sensors = sensors

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write `action` `[*B, K]`."""
        cell = tensordict["last_cell"]
        return tensordict.set("action", cell.new_ones((*cell.shape, self.sensors), dtype=torch.bool))
