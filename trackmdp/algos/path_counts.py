"""Path counts: learn policies that remember more than the cell, by counting on fully sensed paths."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from trackmdp.algos.common import arrays, tensors
from trackmdp.algos.segments import SensedPaths
from trackmdp.config.counting import PathCountsConfig
from trackmdp.errors import UserError
from trackmdp.policies.policy import Policy, as_policy
from trackmdp.policies.saved import packed, unpacked_policy
from trackmdp.solvers.path_counts import plan_keys
from trackmdp.solvers.path_exchange import choose_plan
from trackmdp.world.model import Task

_PLANS = 3
"""Of a run; a last batch that they do not come to has one more."""


class PathCounts:
    """Collects with all sensors on; plans three times in a run, the last time at its end, from all paths so far.

    Args:
        task: grid, rewards, costs and memory.
        cfg: weight of what keys share, discount and rounds.
        iterations: batches to come.
        seed: of the paths by which plans are chosen.
        device: where batches come from; paths and plans are on the CPU.
    """

    def __init__(self, task: Task, cfg: PathCountsConfig, *, iterations: int, seed: int, device: torch.device) -> None:
        if not (task.perfect and task.safe):
            raise UserError("sensor: expected perfect where paths are counted: path_counts, learned_kernel with memory")
        self.task, self.cfg, self.iterations, self.device = task, cfg, iterations, device
        self._paths, self._seed = SensedPaths(task.num_cells), seed
        self._iteration, self._every = 0, max(1, iterations // _PLANS)
        self._told = dict.fromkeys(("paths", "keys_seen", "reward_per_move", "rounds"), math.nan)
        self.actor = Policy.none(task)
        self.policy = _AllSensors(task.num_sensors)

    def step(self, batch: TensorDictBase | None) -> dict[str, float]:
        """Take in one batch `[B, time]` and, where it is time to, plan."""
        self._iteration += 1
        if batch is not None:
            self._paths.extend(batch)
        if self._iteration < self.iterations and self._iteration % self._every:
            return self._told
        tracks, cfg = self._paths.tracks(), self.cfg
        if cfg.prior is None:
            found = choose_plan(self.task, tracks, discount=cfg.gamma, rounds=cfg.rounds, seed=self._seed)
        else:
            found = plan_keys(self.task, tracks, prior=cfg.prior, discount=cfg.gamma, rounds=cfg.rounds)
        self.actor = as_policy(self.task, found.policy)
        moves = max(len(tracks.cells) - len(tracks), 1)
        self._told = {
            "paths": float(len(tracks)),
            "keys_seen": float(found.seen),
            "reward_per_move": found.reward / moves,
            "rounds": float(found.rounds),
        }
        return self._told

    def state_dict(self) -> dict[str, Any]:
        """The paths, what they are parted by, the plan and what is told of it."""
        counts = {"iteration": self._iteration, "told": dict(self._told), "seed": self._seed}
        return counts | {"paths": self._paths.state_dict(), "actor": tensors(packed(self.actor))}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a `state_dict`."""
        self._iteration, self._told, self._seed = state["iteration"], dict(state["told"]), state["seed"]
        self._paths.load_state_dict(state["paths"])
        self.actor = Policy.from_table(unpacked_policy(self.task, arrays(state["actor"])))


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
