"""Learned kernel: estimate the motion from detections, then plan with it as if it were the truth.

What a careful practitioner would try before deep reinforcement learning. Steps are spent with all sensors on, so that
every move is seen, or on sets planned for a kernel drawn from the posterior (posterior sampling, Thompson 1933), which
costs far less and leaves moves to be inferred from misses.
"""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import torch
from scipy import sparse
from tensordict import TensorDictBase

from trackmdp.algos.common import arrays, tensors
from trackmdp.algos.moves import known_as
from trackmdp.algos.path_counts import PathCounts
from trackmdp.config.counting import LearnedKernelConfig
from trackmdp.policies.acting import RenewedTable
from trackmdp.policies.policy import Policy, as_policy
from trackmdp.policies.saved import packed, unpacked_policy
from trackmdp.policies.table import PolicyTable
from trackmdp.seeding import derive
from trackmdp.solvers import exchange
from trackmdp.solvers.alike import cell_classes
from trackmdp.solvers.censored import ObservedPaths
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.kernel_estimate import KernelEstimate
from trackmdp.solvers.keyed_search import solve_keys
from trackmdp.solvers.renewal import DIRECT_CELLS
from trackmdp.solvers.shrinkage import believed_world, least_worth_planning
from trackmdp.world.model import Task
from trackmdp.world.modes import HiddenWorld
from trackmdp.world.windows import Window


def learner(
    task: Task, cfg: LearnedKernelConfig, *, iterations: int, seed: int, device: torch.device
) -> LearnedKernel | PathCounts:
    """What `algo=learned_kernel` stands for: where keys remember detections, these are what is counted by."""
    if task.order:
        return PathCounts(task, cfg.of_keys(), iterations=iterations, seed=seed, device=device)
    return LearnedKernel(task, cfg, iterations=iterations, seed=seed, device=device)


class LearnedKernel:
    """Plans anew after every batch; `actor` is the plan for the posterior mean.

    Args:
        task: grid, rewards and costs.
        cfg: how steps are spent and how much the prior counts.
        iterations: batches to come.
        seed: seed of the run.
        device: where the policies' tables live; the estimate is on the CPU.
    """

    def __init__(
        self, task: Task, cfg: LearnedKernelConfig, *, iterations: int, seed: int, device: torch.device
    ) -> None:
        self.task, self.cfg, self.iterations, self.device = task, cfg, iterations, device
        detection = None if task.perfect else task.detection
        self._estimate = KernelEstimate(
            task.size,
            weight=cfg.prior,
            exit_weight=cfg.exit_prior,
            detection=detection,
            share_cells=False if task.keyed else None if cfg.share_cells is None else cfg.share_cells != "none",
            classes=cell_classes(cfg.share_cells, task.size),
            modes=task.keys.num_classes,
        )
        self._least = least_worth_planning(task) if cfg.negligible is None else cfg.negligible
        self._rng = np.random.default_rng(derive(seed, "learned_kernel"))
        self._chooses, self._warm_up = cfg.sensing == "chosen", cfg.warm_up
        self._iteration, self._spent = 0, np.zeros(2)
        self._believed = dict.fromkeys(("believed_aihtr", "believed_deviation"), math.nan)
        self.actor = Policy.all_on(task)
        self.policy = RenewedTable(task, device, on=True) if self._chooses else Policy.all_on(task)

    def step(self, batch: TensorDictBase | None) -> dict[str, float]:
        """Take in one batch `[B, time]`, plan, and choose the sets of the next one."""
        self._iteration += 1
        if batch is not None:
            self._estimate.add(observed_paths(batch, self.task))
            self._spent += [batch.numel(), _sensors_on(batch)]
        last = self._iteration == self.iterations
        # With all sensors on nothing that is collected depends on a plan: it can wait, on a large grid to the end.
        few = self.iterations if self.task.num_cells > DIRECT_CELLS else max(1, self.iterations // 6)
        every = self.cfg.plan_every or few
        if not (last or self._chooses or self._iteration % every == 0):
            return self._diagnostics()
        self._estimate.fit(self.cfg.rounds_at_end if last else self.cfg.rounds)
        believed = self._estimate.believed(self._least)
        # What is only looked at on the way is made of the plan before, in one round: a quarter of the time.
        plan = self._plan(believed, None if last or self._chooses else self.actor.sets, exchange.OTHERS if last else 0)
        self.actor = as_policy(self.task, plan)
        # Acting on a draw, not on the mean: where the estimate is unsure the draws differ, and so moves get sensed that
        # the mean may leave out for good.
        if isinstance(self.policy, RenewedTable) and self._spent[0] >= self._warm_up:
            self.policy.renew(self._plan(self._estimate.sample(self._rng)))
        self._believed = self._beliefs(plan, believed)
        return self._diagnostics()

    def _plan(self, kernel: sparse.csr_array, start: sparse.csr_array | None = None, others: int = 0) -> PolicyTable:
        """The plan for the `[M, M + 1]` kernel believed, from the sets `start` where there are any.

        Else from those of `search`, and from as many `others`.
        """
        world = believed_world(self.task, kernel, self._least)
        if isinstance(world, HiddenWorld):
            return solve_keys(world, start=None if start is None else PolicyTable(self.task, start)).table
        table = None if start is None else PolicyTable(self.task, start)
        return exchange.solve(world, others) if table is None else exchange.improve(world, table, once=True)

    def _diagnostics(self) -> dict[str, float]:
        """What the last plan is believed to be worth, how sure that is, and what learning has cost so far."""
        frames, sensors = self._spent
        seen = {"least_visits": float(self._estimate.visits.min()), "sensors_per_frame": sensors / max(frames, 1.0)}
        return self._believed | seen

    def _beliefs(self, plan: PolicyTable, kernel: sparse.csr_array) -> dict[str, float]:
        drawn = self._estimate.samples(self._rng, self.cfg.samples)
        # Each begins with the mean kernel's values, which counts where the grid is too large to factorise.
        mean = evaluate(believed_world(self.task, kernel, self._least), plan, per_cell=False)
        others = (believed_world(self.task, other, self._least) for other in drawn)
        worth = [evaluate(other, plan, guess=mean.value, per_cell=False).aihtr for other in others]
        return {"believed_aihtr": mean.aihtr, "believed_deviation": float(np.std(worth))}

    def state_dict(self) -> dict[str, Any]:
        """The observations, the estimate, the draws to come and the two tables."""
        return {
            "iteration": self._iteration,
            "spent": torch.as_tensor(self._spent),
            "believed": dict(self._believed),
            "rng": json.dumps(self._rng.bit_generator.state),  # of 128 bits, more than a checkpoint's integers hold
            "estimate": tensors(self._estimate.state()),
            "policy": self.policy.state_dict(),
            "actor": tensors(packed(self.actor)),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a `state_dict`."""
        self._iteration, self._spent = state["iteration"], state["spent"].cpu().numpy().copy()
        self._believed = dict(state["believed"])
        self._rng.bit_generator.state = json.loads(state["rng"])
        self._estimate.load_state(arrays(state["estimate"]))
        self.policy.load_state_dict(state["policy"])
        self.actor = Policy.from_table(unpacked_policy(self.task, arrays(state["actor"])))


def observed_paths(batch: TensorDictBase, task: Task) -> ObservedPaths:
    """The paths that end in a collected batch `[B, time]`: from a detection to the next one or to the exit.

    Where a detection tells the mode they are of keys, and a sensor sees all those of its cell.

    Read is only what the tracker saw: where and when it located the target, its own sets, and that the target left.
    Where the safe action may miss, paths that come to it end before it.
    """
    after = batch["next"]
    exited = after["terminated"].squeeze(-1)
    ended = exited | (after["steps_since_detection"] == 0)
    cell, misses = (batch[key][ended] for key in ("last_cell", "steps_since_detection"))
    name = known_as(batch)
    start, end = batch[name][ended], torch.where(exited, task.num_keys, after[name])[ended]
    if not task.safe:  # how many safe actions it took is not told: what is known ends with the last set
        end = torch.where(misses == task.num_choices, task.num_keys + 1, end)
    # A path's sets are in the history of the step that ended it, wherever the batch began; those of paths without a
    # miss, with all sensors on most of a batch, stay unread.
    missed = misses.nonzero().squeeze(-1)
    history = batch["action_history"][ended & (batch["steps_since_detection"] > 0)]
    path, miss, sensor = history.nonzero(as_tuple=True)
    if task.window is not None:  # numbered within the window of the located cell; those outside the grid sense nothing
        sensor = Window.of(task, sensor.device).around(cell[missed])[path, sensor]
    there = sensor < task.total_sensors
    place = ((missed[path] * task.num_choices + miss)[there].cpu().numpy(), sensor[there].cpu().numpy())
    shape = (len(start) * task.num_choices, task.total_sensors)
    sensed = sparse.csr_array((np.ones(len(place[0]), dtype=bool), place), shape=shape)
    if task.coverage is not None:
        sensed = task.coverage.seen(sensed)
    if task.keyed:
        sensed = sparse.kron(sensed, np.ones((1, task.keys.num_classes), dtype=bool), format="csr")
    return ObservedPaths(start.cpu().numpy(), misses.cpu().numpy(), sensed, end.cpu().numpy())


def _sensors_on(batch: TensorDictBase) -> float:
    """Sensors switched on by choice in a batch."""
    # At n = t_max + 1 the safe action replaces the policy's, whose sensors are not switched on.
    free = batch["steps_since_detection"] < batch["action_history"].shape[-2]
    if free.all():
        return float(batch["action"].count_nonzero())
    return (batch["action"].sum(-1) * free).sum().item()
