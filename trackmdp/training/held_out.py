"""Evaluation without a motion model: how a policy does on recorded tracks that no learner has seen."""

from __future__ import annotations

import math
from dataclasses import asdict
from functools import cached_property
from typing import Any

import numpy as np
from scipy import sparse

from trackmdp.config.values import choice_values
from trackmdp.policies.table import PolicyTable
from trackmdp.solvers import qmdp
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.evaluation import Evaluation
from trackmdp.solvers.kernel_estimate import KernelEstimate
from trackmdp.solvers.path_exchange import choose_plan
from trackmdp.solvers.recorded import ReplayedTracks, replay
from trackmdp.statistics import MeanInterval
from trackmdp.training.evaluator import Evaluator, ExactEvaluator, Score
from trackmdp.world.model import World
from trackmdp.world.tracks import Problem, Recorded, Tracks

ESTIMATED = "Q_MDP of the estimated kernel"
"""Q_MDP for the motion as the tracks to learn from show it."""
CELL_ALONE = "task.memory=cell"
"""The best policy found for those tracks that remembers the cell alone."""


def make_evaluator(problem: Problem) -> Evaluator:
    """Exact where there is a motion model, else on the held-out tracks."""
    return HeldOutEvaluator(problem) if isinstance(problem, Recorded) else ExactEvaluator(problem)


class HeldOutEvaluator(Evaluator):
    """Evaluates on every held-out track, from its first cell to its end; scores are those of the validation tracks.

    Whatever is looked at while learning, or to choose between policies, is a score: the best of many policies on the
    held-out tracks would be the luckiest there. Without a motion model there are no bounds, no Q_MDP and no regret:
    `upper` and the scores' regrets are nan.

    Args:
        world: the task and its recorded tracks, each truncated after `max_steps` steps.
    """

    world: Recorded

    def __init__(self, world: Recorded) -> None:
        self.world = world
        self.tracks = world.held_out.limited(world.max_steps)
        self.upper, self.lower, self.qmdp = math.nan, math.nan, None
        self.bounds = dict.fromkeys(("paper", "valid", "clocked"))

    def evaluate(self, policy: PolicyTable) -> Evaluation:
        """Figures of a policy on the held-out tracks."""
        return evaluate(self.world, policy)

    def score(self, policy: PolicyTable) -> Score:
        """Figures of a policy on the validation tracks."""
        return Score(evaluate(self.world.selection, policy), math.nan, math.nan)

    def intervals(self, policy: PolicyTable) -> dict[str, MeanInterval]:
        """Figure -> its mean over the held-out tracks with a 95 % confidence interval."""
        return self.replayed(policy).intervals(self.tracks.names)

    def replayed(self, policy: PolicyTable) -> ReplayedTracks:
        """What a policy did on the held-out tracks."""
        return replay(self.world, self.tracks, policy)

    @cached_property
    def references(self) -> dict[str, PolicyTable]:
        """The policies that a learned one is compared with, by their names in tables."""
        task = self.world
        kernel = estimated_kernel(task.tracks, task.size)
        world = World.of(task, kernel, max_steps=None, window=None, memory="cell")
        found: dict[str, PolicyTable] = {}
        # Only what remembers more is compared with it; and counts take sensors of one cell that never miss.
        if task.keyed and task.perfect and task.safe and task.coverage is None:
            gamma, rounds = (choice_values("algo", "path_counts", {})[name] for name in ("gamma", "rounds"))
            cell = task.remembering()
            plan = choose_plan(cell, task.tracks, judge=task.validation, discount=gamma, rounds=rounds)
            found[CELL_ALONE] = plan.policy
        fixed = {"all on": PolicyTable.all_on(task), "no sensors": PolicyTable.none(task)}
        return found | fixed | {ESTIMATED: qmdp.solve(world)}

    def report(self, policy: PolicyTable) -> dict[str, Any]:
        """What is written of a policy: its figures on the held-out tracks beside those of the references."""
        policies = {"policy": policy, **self.references}
        figures = {
            name: {figure: asdict(interval) for figure, interval in self.intervals(each).items()}
            for name, each in policies.items()
        }
        counts = {"learned_from": self.world.tracks, "validation": self.world.validation, "tracks": self.tracks}
        return {name: len(part) for name, part in counts.items()} | {"figures": figures}


def estimated_kernel(tracks: Tracks, size: tuple[int, int]) -> sparse.csr_array:
    """`[M, M]` the motion as `tracks` show it: posterior mean, the prior of a row counting as one move."""
    estimate = KernelEstimate(size, weight=1.0, exit_weight=1.0)
    line = tracks.closed(estimate.num_cells)
    moves = np.ones(len(line.cells), dtype=bool)
    # Example: the tracks 3 4 (exit) and 7 8 stand end to end as cells = 3 4 M 7 8 with first = 0 3 5. Every place but
    # a track's last one (2 and 4) begins a move: 3 to 4, 4 to M, 7 to 8.
    moves[line.first[1:] - 1] = False
    at = np.flatnonzero(moves)
    estimate.add_moves(line.cells[at], line.cells[at + 1])
    estimate.fit(1)
    # `[M, M + 1]`, the last column being the exit, which a kernel `[M, M]` leaves to its rows' missing mass.
    return sparse.csr_array(estimate.mean()[:, :-1])
