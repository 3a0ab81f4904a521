"""Actors: the decisions of a policy, playback or function in a batch of states, given the uniform draws.

A step asks three things of a decision: whether the target is sensed where it turns up, how many sensors are on, and
what they cost. A table answers them from one row per state, so that a step costs the same on any grid; whatever else
acts writes its action out over all S sensors.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np
import torch
from torch import Tensor

from trackmdp.policies.playback import Playback
from trackmdp.policies.policy import Policy, PolicyLike, as_policy, looked_up, rule_of
from trackmdp.policies.unroll import DrawsError, Rule, acting
from trackmdp.world.costs import Costs
from trackmdp.world.model import Task
from trackmdp.world.sight import Sight
from trackmdp.world.windows import Window

_MOST_ROWS = 4096  # episodes stepped together: their generators take 5 kB each
_DRAWS = 25_600  # of one step: 256 steps of them are held at a time, 26 MB
_HISTORY = 2**24  # entries of the action history of all rows


@dataclass(frozen=True)
class States:
    """Where B episodes are before a step.

    Attributes:
        row: `[B]` which episodes of the batch these are.
        last_cell: `[B]` cell of the last detection.
        key: `[B]` what the policy remembered there; the cell, where that is all.
        misses: `[B]` n since then.
        step: steps done so far.
    """

    row: Tensor
    last_cell: Tensor
    key: Tensor
    misses: Tensor
    step: int


class Choice(Protocol):
    """What was decided in B states."""

    @property
    def count(self) -> Tensor:
        """`[B]` int64, sensors on."""
        ...

    @property
    def spent(self) -> Tensor:
        """`[B]` float32, their price."""
        ...

    @property
    def action(self) -> Tensor | None:
        """`[B, S]` bool; None where it follows from the state, and need not be kept."""
        ...

    def sensed(self, cell: Tensor) -> Tensor:
        """`[B]` bool, whether a sensor that is on sees `cell` `[B]`."""
        ...


class Actor(Protocol):
    """Anything that acts."""

    @property
    def policy(self) -> Policy | None:
        """From which a step's action and its probabilities follow, where it is a `Policy`."""
        ...

    @property
    def num_draws(self) -> int:
        """Uniform draws that one decision takes from the episode's own generator."""
        ...

    @property
    def most_rows(self) -> int:
        """Episodes it can be asked for at a time."""
        ...

    def decide(self, states: States, draws: Tensor) -> Choice:
        """The decisions in `states`; `draws` is `[B, num_draws]`, uniform in [0, 1)."""
        ...


@dataclass(frozen=True)
class _Rows:
    """Rows of a table."""

    table: Callable[[Tensor, Tensor], Tensor]
    row: Tensor
    count: Tensor
    spent: Tensor
    action: ClassVar[Tensor | None] = None

    def sensed(self, cell: Tensor) -> Tensor:
        return self.table(self.row, cell)


@dataclass(frozen=True)
class _Same:
    """All sensors, or none, in every state."""

    seen: Tensor
    count: Tensor
    spent: Tensor
    action: ClassVar[Tensor | None] = None

    def sensed(self, cell: Tensor) -> Tensor:
        return self.seen[cell]


class _Written:
    """Actions written out over all sensors."""

    def __init__(self, action: Tensor, costs: Costs, sight: Sight) -> None:
        self.action: Tensor | None = action
        self._on, self._sight = action, sight
        self.count, self.spent = action.sum(-1), costs.price_of(action)

    def sensed(self, cell: Tensor) -> Tensor:
        return self._sight.sees(self._on, cell, cell)


class Following:
    """A deterministic policy with a table."""

    num_draws, most_rows = 0, _MOST_ROWS

    def __init__(self, policy: Policy, costs: Costs) -> None:
        assert policy.sets is not None
        self.policy, cpu = policy, torch.device("cpu")
        self._table = policy.lookup(cpu) if policy.seen is policy.sets else looked_up(policy.seen, cpu)
        # A CSR matrix's indptr says where each row's entries begin: 0 2 2 5 are rows of 2, 0 and 3 sensors.
        self._count = torch.as_tensor(np.diff(policy.sets.indptr).astype(np.int64))
        self._spent = costs.of_sets(policy.sets)

    def decide(self, states: States, draws: Tensor) -> Choice:  # noqa: ARG002
        """See `Actor`."""
        row = self.policy.row(states.key, states.misses)
        return _Rows(self._table.entry, row, self._count[row], self._spent[row])


class Uniform:
    """All sensors on, or none."""

    num_draws, most_rows = 0, _MOST_ROWS

    def __init__(self, policy: Policy, costs: Costs) -> None:
        self.policy = policy
        on, coverage = policy.probability == 1.0, policy.task.coverage
        action = torch.full((1, policy.task.total_sensors), on)
        self._seen = torch.full((policy.task.num_cells,), on)
        if coverage is not None:
            self._seen &= torch.as_tensor(coverage.degree) > 0
        self._count, self._spent = action.sum(-1), costs.price_of(action)

    def decide(self, states: States, draws: Tensor) -> Choice:  # noqa: ARG002
        """See `Actor`."""
        b = len(states.row)
        # expand repeats one number B times without memory of its own.
        return _Same(self._seen, self._count.expand(b), self._spent.expand(b))


class Drawing:
    """A policy that draws its sets."""

    def __init__(self, policy: Policy, costs: Costs) -> None:
        self.policy, self._costs, self.num_draws = policy, costs, policy.num_draws
        self._sight = Sight(policy.task, everywhere=True)
        self.most_rows = max(1, min(256, _DRAWS // policy.num_draws))

    def decide(self, states: States, draws: Tensor) -> Choice:
        """See `Actor`."""
        return _Written(self.policy.act(states.key, states.misses, draws), self._costs, self._sight)


class Issuing:
    """Recorded actions, one a step."""

    num_draws, most_rows, policy = 0, 256, None

    def __init__(self, playback: Playback, costs: Costs) -> None:
        self._playback, self._costs, self._window = playback, costs, Window.of(playback.task)
        self._sight = Sight(playback.task, everywhere=True)

    def decide(self, states: States, draws: Tensor) -> Choice:  # noqa: ARG002
        """See `Actor`."""
        action = self._playback.at(states.step).expand(len(states.row), -1).contiguous()
        if self._window.is_local:  # what lies outside the window cannot be chosen
            action = self._window.to_global(states.last_cell, self._window.to_local(states.last_cell, action))
        return _Written(action, self._costs, self._sight)


class Asking:
    """A function or module that draws from a source of its own, asked at every step."""

    num_draws, policy = 0, None

    def __init__(self, task: Task, rule: Rule, costs: Costs) -> None:
        self._rule, self._costs, self._window = rule, costs, Window.of(task)
        self._sight = Sight(task, everywhere=True)
        self._slots = torch.arange(task.num_choices)
        self.most_rows = max(1, min(_MOST_ROWS, _HISTORY // (task.num_choices * task.num_sensors)))
        self._history = torch.zeros(self.most_rows, task.num_choices, task.num_sensors, dtype=torch.bool)

    def decide(self, states: States, draws: Tensor) -> Choice:  # noqa: ARG002
        """See `Actor`."""
        # Slot s holds the action at s misses; what stands in slot n and later is left from an earlier row of misses.
        filled = self._slots < states.misses.unsqueeze(1)
        history = self._history[states.row] & filled.unsqueeze(-1)
        with acting():
            action = self._rule(states.last_cell, states.misses, history)
        self._history[states.row, states.misses.clamp_max(len(self._slots) - 1)] = action
        return _Written(self._window.to_global(states.last_cell, action), self._costs, self._sight)


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
        return Asking(task, rule_of(task.remembering(), policy), costs)  # asked step by step, it is told the cell alone
    if not made.deterministic:
        return Drawing(made, costs)
    return Uniform(made, costs) if made.sets is None else Following(made, costs)
