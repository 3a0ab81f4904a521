"""Actors: the decisions of a policy, playback or function in a batch of states, given the uniform draws.

A step asks three things of a decision: whether the target is sensed where it turns up, how many sensors are on, and
what they cost. A table answers them from one row per state, so that a step costs the same on any grid; whatever else
acts writes its action out over all S sensors.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from scipy import sparse
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from trackmdp.policies.playback import Playback
from trackmdp.policies.policy import Policy, PolicyLike, as_policy, looked_up, rule_of
from trackmdp.policies.unroll import STATE_KEYS, DrawsError, Rule, acting, kept_keys, module_action
from trackmdp.world.costs import Costs
from trackmdp.world.model import Task
from trackmdp.world.windows import Sight, Window

_MOST_ROWS = 4096  # episodes stepped together: their generators take 5 kB each
_DRAWS = 25_600  # of one step: 256 steps of them are held at a time, 26 MB
_HISTORY = 2**24  # entries of the action history of all rows


@dataclass(frozen=True)
class States:
    """Where the B episodes that are still running are before a step.

    Attributes:
        row: `[B]` which episodes of the batch these are.
        place: `[B]` of the targets (`world/targets.py`), for the simulator's eyes.
        last_cell: `[B]` cell of the last detection.
        key: `[B]` what the policy remembered there; the cell, where that is all.
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
        return replace(self, **{name: part[rows] for name, part in vars(self).items() if name != "step"})


@dataclass(frozen=True)
class Choice:
    """What was decided in B states.

    Attributes:
        count: `[B]` int64, sensors on.
        spent: `[B]` float32, their price.
        sensed: whether a sensor that is on sees a cell, `[B]` bool of cells `[B]`.
        action: `[B, S]` bool; None where it follows from the state, and need not be kept.
    """

    count: Tensor
    spent: Tensor
    sensed: Callable[[Tensor], Tensor]
    action: Tensor | None = None


class Actor(ABC):
    """Anything that acts.

    Attributes:
        policy: from which a step's action and its probabilities follow, where it is a `Policy`.
        num_draws: uniform draws that one decision takes from the episode's own generator.
        most_rows: episodes it can be asked for at a time.
    """

    policy: Policy | None = None
    num_draws: int = 0
    most_rows: int = _MOST_ROWS

    @abstractmethod
    def decide(self, states: States, draws: Tensor) -> Choice:
        """The decisions in `states`; `draws` is `[B, num_draws]`, uniform in [0, 1)."""


class _Writing(Actor):
    """Writes its actions out over all sensors."""

    def __init__(self, task: Task, costs: Costs) -> None:
        self._costs, self._window, self._sight = costs, Window.of(task), Sight(task, everywhere=True)

    @abstractmethod
    def _action(self, states: States, draws: Tensor) -> Tensor:
        """`[B, S]` sensors on."""

    def decide(self, states: States, draws: Tensor) -> Choice:
        """See `Actor`."""
        action = self._action(states, draws)
        spent = self._costs.price_of(action)
        return Choice(action.sum(-1), spent, lambda cell: self._sight.sees(action, cell, cell), action)


class Following(Actor):
    """A deterministic policy: a row of its table for each state, or one for all where all sensors are on, or none."""

    policy: Policy

    def __init__(self, policy: Policy, costs: Costs) -> None:
        self.policy, sets, coverage = policy, policy.sets, policy.task.coverage
        if sets is None:
            sets = sparse.csr_array(np.full((1, policy.task.total_sensors), policy.probability == 1.0))
            seen = sets if coverage is None else coverage.seen(sets)
        else:
            seen = policy.seen
        cpu = torch.device("cpu")
        self._table = policy.lookup(cpu) if seen is policy.sets else looked_up(seen, cpu)
        # A CSR matrix's indptr says where each row's entries begin: 0 2 2 5 are rows of 2, 0 and 3 sensors.
        self._count = torch.as_tensor(np.diff(sets.indptr).astype(np.int64))
        self._spent = costs.of_sets(sets)

    def decide(self, states: States, draws: Tensor) -> Choice:  # noqa: ARG002
        """See `Actor`."""
        alike = self.policy.sets is None
        row = torch.zeros_like(states.key) if alike else self.policy.row(states.key, states.misses)
        return Choice(self._count[row], self._spent[row], partial(self._table.entry, row))


class Drawing(_Writing):
    """A policy that draws its sets."""

    policy: Policy

    def __init__(self, policy: Policy, costs: Costs) -> None:
        super().__init__(policy.task, costs)
        self.policy, self.num_draws = policy, policy.num_draws
        self.most_rows = max(1, min(256, _DRAWS // policy.num_draws))

    def _action(self, states: States, draws: Tensor) -> Tensor:
        return self.policy.act(states.key, states.misses, draws)


class Issuing(_Writing):
    """Recorded actions, one a step."""

    most_rows = 256

    def __init__(self, playback: Playback, costs: Costs) -> None:
        super().__init__(playback.task, costs)
        self._playback = playback

    def _action(self, states: States, draws: Tensor) -> Tensor:  # noqa: ARG002
        action = self._playback.at(states.step).expand(len(states.row), -1).contiguous()
        if self._window.is_local:  # what lies outside the window cannot be chosen
            action = self._window.to_global(states.last_cell, self._window.to_local(states.last_cell, action))
        return action


class Asking(_Writing):
    """A function or module that draws from a source of its own, asked at every step."""

    def __init__(self, task: Task, rule: Rule, costs: Costs) -> None:
        super().__init__(task, costs)
        self._rule, self._slots = rule, torch.arange(task.num_choices)
        self.most_rows = max(1, min(_MOST_ROWS, _HISTORY // (task.num_choices * task.num_sensors)))
        self._history = torch.zeros(self.most_rows, task.num_choices, task.num_sensors, dtype=torch.bool)

    def _action(self, states: States, draws: Tensor) -> Tensor:  # noqa: ARG002
        # Slot s holds the action at s misses; what stands in slot n and later is left from an earlier row of misses.
        filled = self._slots < states.misses.unsqueeze(1)
        history = self._history[states.row] & filled.unsqueeze(-1)
        with acting():
            action = self._ask(states, history)
        self._history[states.row, states.misses.clamp_max(len(self._slots) - 1)] = action
        return self._window.to_global(states.last_cell, action)

    def _ask(self, states: States, history: Tensor) -> Tensor:
        return self._rule(states.last_cell, states.misses, history)


class Remembering(Asking):
    """A recurrent module; what it keeps from step to step is kept for each episode. At the first step it is None."""

    def __init__(self, task: Task, module: TensorDictModuleBase, costs: Costs) -> None:
        super().__init__(task, partial(module_action, task, module), costs)
        self._keys, self._kept = kept_keys(module), dict[str, Tensor]()

    def _ask(self, states: States, history: Tensor) -> Tensor:
        said = dict(zip(STATE_KEYS, (states.last_cell, states.misses, history), strict=True))
        batch = TensorDict(said, len(states.row)).set("is_init", torch.full((len(states.row), 1), states.step == 0))
        if states.step:
            batch.update({key: value[states.row] for key, value in self._kept.items()})
        action = self._rule(batch)
        for key in self._keys:
            after = batch["next", key]
            if states.step == 0:
                self._kept[key] = after.new_zeros(self.most_rows, *after.shape[1:])
            self._kept[key][states.row] = after
        return action


def actor_of(task: Task, policy: PolicyLike | Playback, costs: Costs) -> Actor:
    """What steps a policy; a function or module that does not draw is turned into its table first.

    Raises:
        UserError: the policy is made for another grid, or is none.
    """
    if isinstance(policy, Playback):
        return Issuing(policy, costs)
    try:
        made = as_policy(task, policy)
    except DrawsError:
        told = task.remembering()  # asked step by step, it is told the cell alone
        if isinstance(policy, TensorDictModuleBase) and kept_keys(policy):
            return Remembering(told, policy, costs)
        return Asking(task, rule_of(told, policy), costs)
    return Following(made, costs) if made.deterministic else Drawing(made, costs)
