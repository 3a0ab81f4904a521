"""Model-based learning: estimate the motion from the observations, then plan with the estimate; no networks.

Where the next move depends on the cell alone, the estimate is a kernel of pooled moves, planned on by the solvers.
Where it may not, plans are made on whole sensed paths; a quarter of them, not used for learning, chooses between these
plans, the plan of the pooled moves and, on small grids, the plan for a target with hidden modes.
Steps are spent with all sensors on, or on sets planned for a kernel drawn from the posterior (posterior sampling,
Thompson 1933), which costs far less and leaves moves to be inferred from misses.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from scipy import sparse
from tensordict import TensorDictBase

from trackmdp.algos.common import (
    NEVER_LOCATED,
    Checkpointed,
    arrays,
    known_alone,
    lifted,
    located,
    tensors,
)
from trackmdp.algos.estimates.alike import cell_classes
from trackmdp.algos.estimates.hidden_modes import Fit, fit_modes
from trackmdp.algos.estimates.kernel_estimate import KernelEstimate
from trackmdp.algos.estimates.path_counts import plan_paths
from trackmdp.algos.estimates.path_gains import Paths, thinned
from trackmdp.algos.estimates.path_plans import TRIED, UNJUDGED, Maker, choose_plan
from trackmdp.algos.estimates.shrinkage import least_worth_planning, without
from trackmdp.algos.observed import SensedPaths, observed_paths
from trackmdp.config.counting import ModelBasedConfig
from trackmdp.errors import UserError
from trackmdp.policies.acting import RenewedTable
from trackmdp.policies.policy import Policy, as_policy
from trackmdp.policies.saved import packed, unpacked_policy
from trackmdp.policies.table import PolicyTable
from trackmdp.recordings.tracks import Tracks
from trackmdp.seeding import derive
from trackmdp.sensing.task import Task
from trackmdp.solvers import exchange, hidden
from trackmdp.solvers.linear import DIRECT_CELLS
from trackmdp.solvers.optimal import plan_without_proof
from trackmdp.solvers.value import value_of
from trackmdp.world.model import World

_PRIOR, _EXIT_PRIOR = 0.1, 100.0
"""Moves as many as which the pooled motion, and the pooled exit probability, count in kernels that are drawn or infer
moves from misses. For plans the counts give the weights (`shrinkage`)."""
_PLANS_OF_MOVES, _PLANS_OF_PATHS = 6, 3
_LAST = 50
"""Times the rounds of expectation-maximisation, at most, after the last batch."""
_SAMPLES = 8
"""Kernels drawn for the uncertainty reported."""
_MOST_CELLS = 1_600
"""Cells up to which plans of pooled moves are tried beside those of paths."""
_MODES, _MOST_STATES = 12, 500
"""Hidden modes of the motion that is fitted as well, up to so many pairs of a cell and a mode. With six modes plans for
nine velocities end .04 a step lower."""


class ModelBased(Checkpointed):
    """Plans some times in a run, the last time at its end, from all that was sensed so far.

    Args:
        task: grid, rewards, costs and memory.
        cfg: how steps are spent, and the kind of estimate.
        iterations: batches to come.
        seed: seed of the run.
        device: where the policies' tables live; the estimates are on the CPU.
    """

    parts = (
        "_iteration",
        "_frames",
        "_sensors",
        "_found",
        "_rng",
        "_estimate",
        "_paths",
        "policy",
    )

    def __init__(
        self, task: Task, cfg: ModelBasedConfig, *, iterations: int, seed: int, device: torch.device
    ) -> None:
        self.task, self.cfg, self.iterations, self.device = task, cfg, iterations, device
        self._located, self._seed = located(task), seed
        by = cfg.estimate or ("moves" if task.markov else None)
        self._paths = None if by == "moves" else SensedPaths(task, seed=derive(seed, "hidden"))
        limited = task.budget is not None
        self._chooses, self._warm_up = cfg.chooses(task.budget), 0 if limited else cfg.warm_up
        self._compares = by is None and task.num_cells <= _MOST_CELLS
        self._estimate = self._new_estimate()
        self._least = least_worth_planning(task)
        self._rng = np.random.default_rng(derive(seed, "model_based"))
        self._iteration, self._frames, self._sensors = 0, 0, 0.0
        beliefs = ("believed_aihtr", "believed_deviation")
        on_paths = ("keys_seen", "reward_per_move")
        self._found = dict.fromkeys(beliefs if by == "moves" else on_paths, math.nan)
        self._plan: PolicyTable | None = None
        self._fit: Fit | None = None
        # Under a budget the safe action alone locates the target at first, and moves are inferred from where it was.
        self.actor = Policy.none(task) if limited else Policy.all_on(task)
        self.policy = RenewedTable(task, device, on=not limited) if self._chooses else self.actor

    def _new_estimate(self) -> KernelEstimate:
        share, task = self.cfg.share_cells, self._located
        return KernelEstimate(
            task.size,
            weight=_PRIOR,
            exit_weight=_EXIT_PRIOR,
            # A mode that is revealed moves on its own; else where the moves seen show no difference.
            share_cells=False if task.keyed else None if share is None else share != "none",
            classes=cell_classes(share, task.size),
            modes=task.keys.num_classes,
        )

    def step(self, batch: TensorDictBase | None) -> dict[str, float]:
        """Take in one batch `[B, time]`, plan where it is time to, and choose the sets of the next one."""
        self._iteration += 1
        if batch is not None:
            self._frames += batch.numel()
            self._sensors += _sensors_on(batch)
            if self._paths is not None:
                self._paths.extend(batch)
            if self._paths is None or self._chooses:
                self._estimate.add(observed_paths(known_alone(batch, self.task), self._located))
        last = self._iteration == self.iterations
        due = last or self._iteration % self._every == 0
        renews = self._chooses and not last and self._iteration % (self.cfg.plan_every or 1) == 0
        if renews or (due and self._paths is None):
            self._estimate.fit(self.cfg.rounds * (_LAST if last else 1))
        if due:
            self._follow(self._plan_moves(last) if self._paths is None else self._plan_paths(last))
        if renews and self._frames >= self._warm_up:
            self._draw()
        return self._diagnostics()

    def _follow(self, plan: PolicyTable) -> None:
        """Take a plan as the policy that is evaluated."""
        self._plan, self.actor = plan, as_policy(self.task, lifted(self.task, plan))

    def _draw(self) -> None:
        """Act on the plan for a drawn kernel.

        Not on that for the mean: where the estimate is unsure the draws differ, and so moves get sensed that the mean
        may leave out for good.
        """
        assert isinstance(self.policy, RenewedTable)
        drawn = self._world(next(self._estimate.samples(self._rng, 1)))
        self.policy.renew(lifted(self.task, plan_without_proof(drawn, 0)))

    @property
    def _every(self) -> int:
        """Batches from one plan to the next: with all sensors on nothing that is collected depends on it."""
        if self.cfg.plan_every or (self._chooses and self._paths is None):
            return self.cfg.plan_every or 1
        plans = _PLANS_OF_MOVES if self._paths is None else _PLANS_OF_PATHS
        large = self.task.num_cells > DIRECT_CELLS
        return self.iterations if large else max(1, self.iterations // plans)

    def _plan_moves(self, last: bool) -> PolicyTable:
        """The plan for the posterior mean of the kernel; between batches one round from the plan before."""
        world = self._world(self._estimate.believed(self._least))
        if last or self._chooses:
            plan = plan_without_proof(world, exchange.OTHERS if last else 0)
        else:
            before = self._plan if self._plan is not None else PolicyTable.all_on(world)
            plan = exchange.improve(world, before, once=True)
        self._found = self._beliefs(plan, world)
        return plan

    def _plan_paths(self, last: bool) -> PolicyTable:
        """The plan on the sensed paths: at the end the best one of several on validation paths.

        Raises:
            UserError: there are none at the end.
        """
        assert self._paths is not None
        task, cfg, tracks = self.task, self.cfg, self._paths.tracks()
        if not len(tracks):
            if last:
                raise UserError(NEVER_LOCATED)
            return self.actor
        if last and cfg.prior is None:
            others: list[Maker] = [self._pooled] if self._compares else []
            if self._compares and _MODES * task.num_cells <= _MOST_STATES:
                others.append(self._with_modes)
            found = choose_plan(
                task,
                tracks,
                others=others,
                discount=cfg.gamma,
                rounds=cfg.rounds,
                seed=self._seed,
            )
        else:
            some = tracks if last else thinned(task, tracks, TRIED, self._seed)
            paths = Paths(task, some, cfg.gamma)
            prior = UNJUDGED * paths.copies if cfg.prior is None else cfg.prior
            found = plan_paths(paths, prior=prior, rounds=cfg.rounds)
        reward, seen = found.reward / max(found.paths.moves, 1), len(found.paths.keys)
        self._found = {"keys_seen": float(seen), "reward_per_move": reward}
        return found.policy

    def _pooled(self, tracks: Tracks, _: PolicyTable | None) -> PolicyTable:
        """The plan for the moves of `tracks`, as if the next one depended on the cell alone."""
        estimate = self._new_estimate()
        estimate.add_moves(*tracks.steps(self.task.num_cells))
        world = self._world(estimate.believed(self._least))
        return lifted(self.task, exchange.solve(world, 0))

    def _with_modes(self, tracks: Tracks, before: PolicyTable | None) -> PolicyTable:
        """The plan for a target with hidden modes."""
        seed, earlier = derive(self._seed, "modes"), None if before is None else self._fit
        self._fit = fit_modes(tracks, self.task.num_cells, _MODES, seed, earlier)
        world = self._fit.world(self.task, self._least)
        if before is not None:
            return exchange.improve(world, before)
        return hidden.best_found(world, hidden.SHORT)

    def _world(self, kernel: sparse.csr_array) -> World:
        """The task with the motion of a `[M, M + 1]` kernel, the last column its exit, without negligible moves."""
        # Plans on several moves grow with a power of the number of moves, most of which the prior may have added.
        moves, task = without(kernel[:, :-1], self._least), self._located
        return World.of(task, moves, modes=task.revealed, max_steps=None)

    def _beliefs(self, plan: PolicyTable, world: World) -> dict[str, float]:
        """AIHTR of a plan by the posterior mean, and its standard deviation over kernels that are drawn."""
        mean = value_of(world, plan)
        others = map(self._world, self._estimate.samples(self._rng, _SAMPLES))
        # Each begins with the mean kernel's values, which counts where the grid is too large to factorise.
        worth = [value_of(other, plan, guess=mean.value).aihtr for other in others]
        return {"believed_aihtr": mean.aihtr, "believed_deviation": float(np.std(worth, ddof=1))}

    def _diagnostics(self) -> dict[str, float]:
        """Figures of the last plan, and the costs of learning so far."""
        found = self._found | {"sensors_per_frame": self._sensors / max(self._frames, 1)}
        if self._paths is not None:
            return found | {"paths": float(len(self._paths))}
        return found | {"least_visits": float(self._estimate.visits.min())}

    def state_dict(self) -> dict[str, Any]:
        """The observations, the draws to come and the tables."""
        plan = None if self._plan is None else tensors(packed(self._plan))
        return super().state_dict() | {"plan": plan}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a `state_dict`."""
        super().load_state_dict(state)
        if state["plan"] is not None:
            task = self._located if self._paths is None else self.task
            self._follow(unpacked_policy(task, arrays(state["plan"])))


def _sensors_on(batch: TensorDictBase) -> float:
    """Sensors switched on by choice in a batch."""
    # At n = t_max + 1 the safe action replaces the policy's set, and no sensor is switched on.
    action, choices = batch["action"], batch["action_history"].shape[-2]
    forced = action[batch["steps_since_detection"] >= choices]
    # Counted as a whole: per row it takes twenty times as long on 64 x 64 cells.
    return float(action.count_nonzero() - forced.count_nonzero())
