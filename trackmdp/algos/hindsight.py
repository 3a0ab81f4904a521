"""Hindsight: learn the sensing policy from fully sensed paths, on which every policy can be replayed.

Sensing never moves the target. With all sensors on, every path shows the detections and misses of any policy
on it. Nothing else is read: neither the kernel nor a position that was not sensed, and no motion is estimated. The
clocked actor and critic only lend credit: the worth of a detection while the actor's own chains are still poor. At the
end the learned sets change jointly where that pays on paths that did not propose it, which gets past the optima that no
change of one set improves (`joint_trials.py`; on whole paths, where the next move does not depend on the cell alone,
`estimates/path_plans.py`, from the sets of either actor).
"""

from __future__ import annotations

import copy
import math
from typing import Any

import numpy as np
import torch
from scipy import sparse
from tensordict import TensorDictBase
from torch import Tensor, nn

from trackmdp.algos.actor_loss import ActorLoss, Decision
from trackmdp.algos.common import (
    NEVER_LOCATED,
    Averages,
    Checkpointed,
    choosable_places,
    known_alone,
    lifted,
    located,
    set_learning_rate,
)
from trackmdp.algos.estimates.alike import cell_classes
from trackmdp.algos.estimates.path_plans import Maker, choose_plan
from trackmdp.algos.hindsight_loss import HindsightLoss
from trackmdp.algos.in_view import SensorsInView
from trackmdp.algos.joint_trials import tried
from trackmdp.algos.moves import MoveBuffer
from trackmdp.algos.path_replay import Replay
from trackmdp.algos.segments import InferredMoves, SegmentBuffer
from trackmdp.arrays.entries import ones_at
from trackmdp.arrays.types import IndexArray
from trackmdp.config.credit import PerSensorConfig
from trackmdp.errors import UserError
from trackmdp.grid.displacements import displacement
from trackmdp.policies.acting import Exploring
from trackmdp.policies.policy import Policy, as_policy
from trackmdp.policies.table import PolicyTable
from trackmdp.seeding import generator
from trackmdp.sensing.task import Task
from trackmdp.sensing.windows import Window

_MOST_CELLS_OF_NETS = 4_096
"""Above, embeddings of each (cell, clock) take time and memory that tables do not. At N = 32 tables end .007 per step
below the optimum where nets end .002 below, and both .002 after the exchange."""
_LATE_DISCOUNT = 0.95
"""Of joint changes. Nets learn faster with less, but what two sets gain together may come several detections later."""
_LONGER = 4
"""As many fewer whole paths per update than paths put together from moves."""
_LOSSES = ("clocked_actor", "clocked_critic", "actor", "critic")


def budget(task: Task, cfg: PerSensorConfig) -> tuple[int, int]:
    """Updates and hidden units: as configured, else by the number of rows (x, n) that the actor has to get right."""
    few = task.num_keys * task.num_choices <= 300
    hidden = 128 if few else 256
    if task.order > 1:  # few such keys occur, and more ended no better, in twice the time
        hidden = 64
    if task.num_keys > _MOST_CELLS_OF_NETS:
        hidden = 0
    # With a memory, plans on whole paths, which begin from the nets' policies, end no better after more updates.
    wanted = 400 if task.order else round(cfg.effort * (500 if few else 800))
    updates = cfg.updates or wanted
    return updates, hidden if cfg.hidden is None else cfg.hidden


class Hindsight(Checkpointed):
    """Collects with all sensors on, then learns from those frames alone; with `collect=mixed` both at once.

    The nets see the target's neighbourhood as far as the frames have shown it to move, so they are made after those, or
    after the frames that come before the mixture. A target that goes farther later counts as gone, for the nets have no
    output for where it is.
    """

    parts = (
        "_seed",
        "_iteration",
        "_update",
        "_buffer",
        "_generator",
        "_learner",
    )

    def __init__(
        self, task: Task, cfg: PerSensorConfig, *, iterations: int, seed: int, device: torch.device
    ) -> None:
        self.cfg, self.device, self._whole_task = cfg, device, task
        # Where the next move depends on the last detection alone, more of the past is of no use.
        self.task = task = located(task) if task.markov else task
        self.updates, self.hidden = budget(task, cfg)
        self._collecting, self._iteration, self._update = iterations, 0, 0
        self._mixed = cfg.collect == "mixed"
        # With `mixed`, learning starts when exploration begins to change.
        share = cfg.explore.begin if self._mixed else 1.0
        self._collect_first = max(1, round(share * iterations))
        alongside = (iterations - self._collect_first) * cfg.updates_per_iteration
        # Updates not done beside the collecting are done after it, updates_per_iteration at a time, rounded up.
        self.iterations = iterations + max(
            0, -(-(self.updates - alongside) // cfg.updates_per_iteration)
        )
        self._generator, self._seed = generator(seed, "hindsight", device=device), seed
        self._loss = self._actor_loss()
        # Whether another policy is better is judged on recordings that nothing was learned from.
        judges = cfg.exchange and not self._mixed
        self._buffer = _buffer(task, cfg.buffer_size, self._generator, seed if judges else None)
        window = Window.of(task, device)
        # [M, K], the sensors of each window that the border cuts off.
        self._outside = window.cells == task.num_cells if window.is_local else None
        self._learner: _Learner | None = None
        self._seen: int | None = None
        self._classes = _classes(task, cfg)
        whole = self._whole_task
        self.actor = Policy.none(whole)
        self.policy = Exploring(whole, device) if self._mixed else Policy.all_on(whole)
        if isinstance(self.policy, Exploring):
            self.policy.explore.fill_(cfg.explore.at(0.0))

    def step(self, batch: TensorDictBase | None) -> dict[str, float]:
        """Store one batch `[B, time]`, then `updates_per_iteration` updates if enough batches are in."""
        self._iteration += 1
        if batch is not None:
            if self._outside is not None:
                # Sensors of the window outside the grid are always off; nothing is missed there, so that a step
                # with all others on is fully sensed.
                batch["action"] = batch["action"] | self._outside[batch["last_cell"]]
            known = known_alone(batch, self._whole_task) if self.task.markov else batch
            self._buffer.extend(known)
            self._seen = None
        averages, cfg = Averages(), self.cfg
        if self._iteration > self._collect_first:
            reach = self._reach()
            learner = self._learner = self._learner or self._make_learner(reach)
            farther = reach > learner.loss.reach
            for _ in range(min(cfg.updates_per_iteration, self.updates - self._update)):
                progress = self._update / self.updates
                learner.loss.actor_loss.prepare(self._update, progress)
                cells = self._paths()
                cells = _within(cells, learner.loss.reach, self.task) if farther else cells
                averages.add(
                    **learner.update(cells, cfg.learning_rate.at(progress), cfg.blend.at(progress))
                )
                self._update += 1
            self._renew_policy(learner)
        losses = averages.means() or dict.fromkeys(_LOSSES, math.nan)
        return {"moves": len(self._buffer), "updates": self._update} | {
            f"loss_{k}": v for k, v in losses.items()
        }

    def _paths(self) -> Tensor:
        """`[T+3, B]` cells: located, T + 1 free choices, the forced step; longer paths where moves do not combine."""
        if isinstance(self._buffer, SegmentBuffer):
            # They are several times as long, and one update takes as much longer.
            return self._buffer.sample(-(-self.cfg.batch_size // _LONGER))
        return self._buffer.paths(self.cfg.batch_size, self.task.t_max + 2)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a `state_dict`."""
        self._seen = self._learner = None
        if saved := state["learner"]:
            self._learner = self._make_learner(saved["reach"])
        # After the learner is made, whose initial weights were drawn from the generator.
        super().load_state_dict(state)
        if self._learner is not None:
            self._renew_policy(self._learner)

    def _renew_policy(self, learner: _Learner) -> None:
        """Rebuild the evaluated policy, and with `collect=mixed` the collecting one, from the averaged actor."""
        table = PolicyTable(self.task, self._exchanged(learner))
        self.actor = as_policy(self._whole_task, lifted(self._whole_task, table))
        if isinstance(self.policy, Exploring):
            self.policy.renew(self.actor)
            self.policy.explore.fill_(self.cfg.explore.at(self._iteration / self._collecting))

    def _exchanged(self, learner: _Learner) -> sparse.csr_array:
        """The learned sets; at the end after joint changes."""
        sets = learner.sets(self.task)
        if not self.cfg.exchange or self._mixed or self._update < self.updates:
            return sets
        if isinstance(self._buffer, MoveBuffer):
            return self._after_trials(self._buffer, sets)
        paths, judge = self._buffer.tracks(), self._buffer.judge
        assert judge is not None
        # No validation path was learned from.
        starts = (PolicyTable(self.task, each) for each in (sets, learner.clocked_sets(self.task)))
        others: list[Maker] = [lambda *_, start=start: start for start in starts]
        found = choose_plan(
            self.task, paths, priors=(), others=others, discount=_LATE_DISCOUNT, seed=judge
        )
        return found.policy.sets

    def _after_trials(self, buffer: MoveBuffer, sets: sparse.csr_array) -> sparse.csr_array:
        """The sets after trials; as they are where nets do not reach, or where cells share them."""
        task = self.task
        if not task.safe or not self.hidden or self._classes is not None:
            return sets

        # Of its own, so that a finished run that is loaded again ends with the same sets.
        rng = generator(self._seed, "trials", device=self.device)

        def draw() -> IndexArray:
            return buffer.paths(self.cfg.batch_size, task.t_max + 2, rng).cpu().numpy()

        return tried(task, sets, draw, _LATE_DISCOUNT)

    def _make_learner(self, reach: int) -> _Learner:
        loss = HindsightLoss(
            self.task,
            self._loss,
            reach=reach,
            hidden=self.hidden,
            discount=self.cfg.gamma,
            generator=self._generator,
            classes=self._classes,
            max_entries=self.cfg.max_entries,
        )
        return _Learner(loss, self.cfg.ema_decay)

    def _actor_loss(self) -> ActorLoss:
        return Decision()

    def _reach(self) -> int:
        """The farthest the target was seen to move in one step, in rows or in columns.

        Raises:
            UserError: it was never seen to move.
        """
        if not len(self._buffer):
            raise UserError(NEVER_LOCATED)
        if self._seen is None:
            self._seen = int(_distance(*self._buffer.moves(), self.task).max())
        return self._seen


def _buffer(
    task: Task, capacity: int, rng: torch.Generator, judge: int | None
) -> MoveBuffer | SegmentBuffer:
    """Paths put together from moves where the next one depends on the cell alone, else only sensed ones."""
    if not task.markov:
        return SegmentBuffer(task, Replay.steps(task.keys), capacity, rng, judge)
    covered = np.diff(task.sees_by_cell[:, task.available].indptr) > 0
    # Of footprints a window may leave out sensors of cells that the target moves to.
    sees = covered.all() and (task.window is None or task.coverage is None)
    return MoveBuffer(task, capacity, rng) if sees else InferredMoves(task, rng)


def _classes(task: Task, cfg: PerSensorConfig) -> IndexArray | None:
    """`[M]`, the class of each cell, or None; cells that share weights share decisions, so their sensors are alike."""
    classes = cell_classes(cfg.share_cells, task.size)
    if classes is None:
        return None
    task_of = {"prices": task.cost, "p_d": task.detection}
    for name, each in task_of.items():
        if not (each == each[0]).all():
            raise UserError(
                f"algo.share_cells={cfg.share_cells}: sensors of different {name}, expected one for all"
            )
    if task.coverage is not None:
        raise UserError(
            f"algo.share_cells={cfg.share_cells}: sensors with footprints, expected one in each cell"
        )
    return classes


def _distance(start: Tensor, end: Tensor, task: Task) -> Tensor:
    """How far moves go, in rows or in columns; 0 where they end outside, in M."""
    start, end = task.keys.cell(start), task.keys.cell(end)
    down, across = displacement(task.columns, start, end)
    moved = torch.maximum(down.abs(), across.abs())
    return moved.masked_fill_(end == task.num_cells, 0)


def _within(cells: Tensor, reach: int, task: Task) -> Tensor:
    """Paths `[steps + 1, B]` on which the target is outside, M, from its first move of more than `reach` on."""
    # cummax keeps the flag up from the first such move on: 0 1 0 becomes 0 1 1.
    gone = (_distance(cells[:-1], cells[1:], task) > reach).cummax(0).values
    return torch.cat([cells[:1], cells[1:].masked_fill(gone, task.num_keys)])


class _Learner(Checkpointed):
    """The nets, their optimizer, and the exponential moving average of the actor, which is replayed and evaluated."""

    parts = ("reach", "loss", "ema", "optimizer", "count")

    def __init__(self, loss: HindsightLoss, ema_decay: float) -> None:
        self.loss, self.reach, self._decay, self.count = loss, loss.reach, ema_decay, 0
        # Paths are replayed with the average: its decisions change less from update to update than those of the
        # weights.
        self.ema = copy.deepcopy(loss.actor).requires_grad_(False)
        self.optimizer = torch.optim.Adam(loss.parameters(), lr=0.0, betas=(0.9, 0.99), fused=True)

    def update(self, cells: Tensor, rate: float, blend: float) -> dict[str, Tensor]:
        """One gradient step on paths `cells` `[T+3, B]`; returns the losses."""
        set_learning_rate(self.optimizer, rate)
        self.optimizer.zero_grad()
        losses: dict[str, Tensor] = {}
        for part in self.loss.parts(cells, self._on(self.ema), blend):
            # Gradients add up over the parts; only one part's graph is in memory.
            torch.stack(list(part.values())).sum().backward()
            losses |= {name: loss.detach() + losses.get(name, 0.0) for name, loss in part.items()}
        self.optimizer.step()
        # At first the average forgets faster, or it would stay with the initial weights.
        decay = min(self._decay, (1 + self.count) / (10 + self.count))
        self.count += 1
        with torch.no_grad():
            for mean, weight in zip(
                self.ema.parameters(), self.loss.actor.parameters(), strict=True
            ):
                mean.lerp_(weight, 1.0 - decay)
        return losses

    @torch.no_grad()
    def _on(self, actor: nn.Module) -> Tensor:
        """`[M, T+1, K]`, the sensors on, as the actor's outputs."""
        return torch.cat([actor(rows) > 0 for rows in self.loss.slices()])

    def sets(self, task: Task) -> sparse.csr_array:
        """`[keys * (T+1), S]` bool, the policy's table."""
        return _rows(task, self.loss.sensors, self._on(self.ema))

    def clocked_sets(self, task: Task) -> sparse.csr_array:
        """The same of the clocked actor: the policy if the position were revealed after every action."""
        return _rows(task, self.loss.nearby, self._on(self.loss.clocked_actor))


def _rows(task: Task, sensors: SensorsInView, on: Tensor) -> sparse.csr_array:
    """`[keys * (T+1), S]` bool, from `on` `[keys, T+1, K]` of the sensors in view."""
    # Entry (key, n, k) is sensor numbers[key, k] in row key (T+1) + n of the table; `nonzero` lists
    # them row by row.
    key, n, local = on.nonzero(as_tuple=True)
    row, cell, column = (
        each.cpu().numpy()
        for each in (key * task.num_choices + n, task.keys.cell(key), sensors.numbers[key, local])
    )
    there = choosable_places(task, cell, column)
    shape = (task.num_keys * task.num_choices, task.total_sensors)
    return ones_at(row[there], column[there], shape)
