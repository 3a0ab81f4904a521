"""Dynamics of the tracking MDP as pure functions of states, actions and draws (paper, Sections II and IV).

A state is a dict of tensors `[B, ...]`: `place`, the hidden state of the target, and everything observed.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeAlias

import torch
from torch import Tensor

from trackmdp.environment.paths import PathSampler
from trackmdp.sensing.actions import ActionMask, words
from trackmdp.sensing.detection import Detection
from trackmdp.sensing.outcomes import Costs, Outcomes
from trackmdp.sensing.task import Task

State: TypeAlias = dict[str, Tensor]

FLAGS = ("done", "terminated", "truncated")


class Dynamics:
    """Initial states and steps of targets in a task, on one device.

    Args:
        task: the task.
        sampler: paths of the targets.

    Attributes:
        detection: the probability of reports.
        masked: whether `action_mask` is observed.
    """

    waits = False
    """Whether targets may enter later."""

    def __init__(self, task: Task, sampler: PathSampler) -> None:
        device = self._device = sampler.device
        self._sampler, self.detection = sampler, Detection(task, device)
        self._costs, self._outcomes = Costs(task, device), Outcomes(task, device)
        self._mask = ActionMask(task, device)
        self.masked = self._mask.observed
        self._num_cells, self._max_steps = task.num_cells, task.max_steps
        self._safe, self._keys = task.safe, task.keys if task.keyed else None
        self._history = (task.num_choices, task.num_sensors)
        self._slots = torch.arange(task.num_choices, device=device)

    def start(self, place: Tensor) -> State:
        """Initial states s_0 = (x_0, 0, ∅) of targets in `place` `[B]`, which are located."""
        cell, none = self._sampler.cell(place), torch.zeros_like(place)
        history = torch.zeros(len(place), *self._history, dtype=torch.bool, device=self._device)
        state = {"place": place, "last_cell": cell.clone()}
        state |= {"steps_since_detection": none, "action_history": history}
        if self._keys:
            state["key"] = self._keys.start(cell, self._sampler.mode(place))
        if self._max_steps:
            state["step_count"] = none.clone()
        if self.masked:
            state["action_mask"] = self._mask(cell)
        return state

    def cell(self, state: Mapping[str, Tensor]) -> Tensor:
        """`[B]` cells of the targets, M after an exit."""
        return self._sampler.cell(state["place"])

    def advance(
        self, state: Mapping[str, Tensor], action: Tensor, draws: Tensor, reports: Tensor | None
    ) -> State:
        """State, reward `[B, 1]` and flags `[B, 1]` after one step.

        Args:
            state: before the step.
            action: `[B, K]` bool.
            draws: `[B]` of the moves, see `PathSampler.draw`.
            reports: `[B]` uniform in [0, 1), of the reports; None where all are certain.
        """
        last, n = state["last_cell"], state["steps_since_detection"]
        place = self._sampler.move(state["place"], draws)
        target = self._sampler.cell(place)
        chosen = action & state["action_mask"] if self.masked else action
        report = self.detection(chosen, last, target)
        spent = self._costs.sensing_cost(chosen, last)
        outcome = self._outcomes(report, spent, n, target, reports)
        following = {
            "place": place,
            # On the exit step `last` stays: the spec has no cell M for it, and done ends the row anyway.
            "last_cell": torch.where(outcome.located, target, last),
            "steps_since_detection": self._outcomes.misses_after(n, outcome),
            "action_history": self._remembered(state["action_history"], action, n, outcome.missed),
            "reward": outcome.reward.unsqueeze(-1),
        }
        if self._keys:
            # For a target that has exited any cell does: it is not located.
            cell, mode = target.clamp_max(self._num_cells - 1), self._sampler.mode(place)
            key = self._keys.next(state["key"], n, cell, mode)
            following["key"] = torch.where(outcome.located, key, state["key"])
        if self.masked:
            following["action_mask"] = self._mask(following["last_cell"])
        if self._max_steps:
            following["step_count"] = state["step_count"] + 1
        return following | self._flags(following, outcome.in_grid)

    def _flags(self, following: State, in_grid: Tensor) -> State:
        """`done`, `terminated` and `truncated` `[B, 1]`."""
        terminated = ~in_grid.unsqueeze(-1)
        cut = self._sampler.stops(following["place"])
        if self._max_steps:
            # Time limit and exit on one step: the exit counts, as nothing is left to bootstrap from.
            late = (following["step_count"] >= self._max_steps) & in_grid
            cut = late if cut is None else cut | late
        if cut is None:
            truncated, done = torch.zeros_like(terminated), terminated.clone()
        else:
            truncated = cut.unsqueeze(-1)
            done = terminated | truncated
        return {"done": done, "terminated": terminated, "truncated": truncated}

    def _remembered(self, history: Tensor, action: Tensor, n: Tensor, missed: Tensor) -> Tensor:
        """h_{k+1}: `action` in slot n where the target was missed, empty elsewhere.

        With t_max = 1: missed at n = 0 gives slots (a, -), missed again at n = 1 gives (a, b); at n = 2 the safe action
        replaces the action, which is not remembered.
        """
        if torch.compiler.is_compiling() or history.device.type != "cpu":
            # All rows: neither a graph nor a GPU should wait for the number of rows that were missed.
            here = (self._slots == n.unsqueeze(-1)).unsqueeze(-1)
            return rowwise(missed, torch.where(here, action.unsqueeze(1), history), False)
        rows = missed.nonzero().squeeze(-1)
        if not rows.numel():
            # Slots n and later are empty: with n = 0 everywhere, as with all sensors on, all are, and stay so.
            return torch.zeros_like(history) if n.any() else history
        # A product of bytes is the fastest way to empty rows: a mask of bools is no vector operation of torch's.
        kept = history.view(torch.uint8) * missed.view(torch.uint8)[:, None, None]
        if not self._safe:
            rows = rows[n[rows] < len(self._slots)]
        slots = n.index_select(0, rows)
        words(kept)[rows, slots] = words(action.index_select(0, rows))
        return kept.view(torch.bool)


def rowwise(rows: Tensor, this: Tensor, that: Tensor | bool) -> Tensor:
    """`this` `[B, ...]` in the rows of a mask `[B]`, `that` in the others."""
    return torch.where(rows.reshape(-1, *[1] * (this.ndim - 1)), this, that)
