"""Actors: the decisions of a policy, playback or function in a batch of states, given the uniform draws.

A step asks three things of a decision: the probability that the target is reported where it turns up, the number of
sensors on, and their price. A table answers them from one row per state, so that a step costs the same on any grid; all
other actors write their action out over all S sensors.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from trackmdp.policies.acting import Playback
from trackmdp.policies.forms import (
    STATE_KEYS,
    DrawsError,
    Rule,
    acting,
    kept_keys,
    module_action,
    rule_of,
)
from trackmdp.policies.lookup import Lookup
from trackmdp.policies.policy import Policy, PolicyLike, as_policy
from trackmdp.sensing.actions import ActionMask
from trackmdp.sensing.detection import Detection
from trackmdp.sensing.outcomes import Costs
from trackmdp.sensing.task import Task
from trackmdp.sensing.windows import Window

_MOST_ROWS = 4096  # episodes stepped together: their generators take 5 kB each
_DRAWS = 25_600  # of one step: 256 steps of them are held at a time, 26 MB
_HISTORY = 2**24  # entries of the action history of all rows


@dataclass(frozen=True)
class States:
    """Where the B episodes that are still running are before a step.

    Attributes:
        row: `[B]` which episodes of the batch these are.
        place: `[B]` of the targets (`environment/targets.py`), for the simulator's eyes.
        last_cell: `[B]` cell of the last detection.
        key: `[B]` the policy's key at it; the cell alone for most policies.
        misses: `[B]` n since then.
        step: steps done so far.
    """

    row: Tensor
    place: Tensor
    last_cell: Tensor
    key: Tensor
    misses: Tensor
    step: int

    def kept(self, rows: Tensor) -> States:
        """Those of the positions `rows`."""
        return replace(
            self, **{name: part[rows] for name, part in vars(self).items() if name != "step"}
        )


@dataclass(frozen=True)
class Choice:
    """The decisions in B states.

    Attributes:
        count: `[B]` int64, sensors on.
        spent: `[B]` float32, their price.
        report: probability that some sensor reports a target, `[B]` of its cells `[B]`; see `Detection`.
        action: `[B, S]` bool; None where it follows from the state, and need not be kept.
    """

    count: Tensor
    spent: Tensor
    report: Callable[[Tensor], Tensor]
    action: Tensor | None = None


Decides: TypeAlias = Callable[[States, Tensor | None], Choice]
"""In B states, given `[B, num_draws]` draws, uniform in [0, 1); None where none are taken."""
Acts: TypeAlias = Callable[[States, Tensor | None], Tensor]
"""The same, giving the action `[B, S]` itself."""
Asks: TypeAlias = Callable[[States, Tensor], Tensor]
"""Given the history `[B, t_max + 1, S]`."""


@dataclass(frozen=True)
class Actor:
    """Anything that acts.

    Attributes:
        decide: the decisions.
        most_rows: episodes it can be asked for at a time.
        policy: from which a step's action and its probabilities follow, where it is a `Policy`.
        num_draws: uniform draws that one decision takes from the episode's own generator.
    """

    decide: Decides
    most_rows: int
    policy: Policy | None = None
    num_draws: int = 0


def actor_of(task: Task, policy: PolicyLike | Playback, costs: Costs) -> Actor:
    """The actor of a policy; a function or module that does not draw is turned into its table first.

    The sensors that report are those of `task`: a policy may have been made for others.

    Raises:
        UserError: the policy is made for another grid, or is no policy.
    """
    if isinstance(policy, Playback):
        return Actor(_writing(task, costs, _issuing(policy)), 256)
    try:
        made = as_policy(task, policy)
    except DrawsError:
        told = task.remembering()  # asked step by step, it is told the cell alone
        most_rows = max(1, min(_MOST_ROWS, _HISTORY // (task.num_choices * task.num_sensors)))
        recurrent = isinstance(policy, TensorDictModuleBase) and kept_keys(policy)
        ask = _remembering(told, policy, most_rows) if recurrent else _asking(rule_of(told, policy))
        return Actor(_writing(told, costs, _with_history(told, ask, most_rows)), most_rows)
    if made.deterministic:
        return Actor(_following(task, made, costs), _MOST_ROWS, made)
    drawing = _writing(
        task, costs, lambda states, draws: made.act(states.key, states.misses, draws)
    )
    draws = made.task.total_sensors
    return Actor(drawing, max(1, min(256, _DRAWS // draws)), made, draws)


def _writing(task: Task, costs: Costs, action_of: Acts) -> Decides:
    """The decisions of a policy with its actions `[B, S]` written out over all sensors."""
    detection = Detection(task, everywhere=True)
    mask = ActionMask(task, everywhere=True)

    def decide(states: States, draws: Tensor | None) -> Choice:
        action = action_of(states, draws)
        if mask.observed:
            action = action & mask(states.last_cell)
        spent = costs.price_of(action)
        return Choice(action.sum(-1), spent, lambda cell: detection(action, cell, cell), action)

    return decide


def _following(task: Task, policy: Policy, costs: Costs) -> Decides:
    """A deterministic policy: the row of its table for each state."""
    sets, table = policy.sets, policy.lookup(torch.device("cpu"))
    if task.coverage is not None:
        table = Lookup(policy.sensed_by(task).reporting, table.device)
    # A CSR matrix's indptr is the place where each row's entries begin: 0 2 2 5 are rows of 2, 0 and 3 sensors.
    count, spent = torch.as_tensor(np.diff(sets.indptr).astype(np.int64)), costs.of_sets(sets)

    detection = Detection(task)

    def decide(states: States, draws: Tensor | None) -> Choice:  # noqa: ARG001
        row = policy.row(states.key, states.misses)
        return Choice(
            count[row], spent[row], lambda cell: detection.of_cell(table.entry(row, cell), cell)
        )

    return decide


def _issuing(playback: Playback) -> Acts:
    """Recorded actions, one a step."""
    window = Window.of(playback.task)

    def action_of(states: States, draws: Tensor | None) -> Tensor:  # noqa: ARG001
        action = playback.at(states.step).expand(len(states.row), -1).contiguous()
        if window.is_local:  # sensors outside the window cannot be chosen
            action = window.to_global(states.last_cell, window.to_local(states.last_cell, action))
        return action

    return action_of


def _with_history(task: Task, ask: Asks, most_rows: int) -> Acts:
    """A function or module that draws from a source of its own, asked at every step with the history of its actions."""
    window, slots = Window.of(task), torch.arange(task.num_choices)
    kept = torch.zeros(most_rows, task.num_choices, task.num_sensors, dtype=torch.bool)

    def action_of(states: States, draws: Tensor | None) -> Tensor:  # noqa: ARG001
        # Slot s holds the action at s misses; slots from n on are left from an earlier row of misses.
        filled = slots < states.misses.unsqueeze(1)
        with acting():
            action = ask(states, kept[states.row] & filled.unsqueeze(-1))
        kept[states.row, states.misses.clamp_max(task.t_max)] = action
        return window.to_global(states.last_cell, action)

    return action_of


def _asking(rule: Rule) -> Asks:
    return lambda states, history: rule(states.last_cell, states.misses, history)


def _remembering(task: Task, module: TensorDictModuleBase, most_rows: int) -> Asks:
    """A recurrent module; its state is kept for each episode from step to step. At the first step it is None."""
    kept = dict[str, Tensor]()

    def ask(states: States, history: Tensor) -> Tensor:
        said = dict(zip(STATE_KEYS, (states.last_cell, states.misses, history), strict=True))
        batch = TensorDict(said, len(states.row)).set(
            "is_init", torch.full((len(states.row), 1), states.step == 0)
        )
        if states.step:
            batch.update({key: value[states.row] for key, value in kept.items()})
        action = module_action(task, module, batch)
        for key in kept_keys(module):
            after = batch["next", key]
            if states.step == 0:
                kept[key] = after.new_zeros(most_rows, *after.shape[1:])
            kept[key][states.row] = after
        return action

    return ask
