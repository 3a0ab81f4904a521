"""Plans of single targets made one policy for several: from the belief of each target, the sensors to switch on.

Merged by gains, sensor j is on iff

    sum over i of m_ij p_d(j) (r + V(j) - W_i(j))  >  c_j P(any target is in the grid),

W_i(j) being the worth of going on with the plan of target i, the target being in j undetected. Of footprints it is the
best set for these gains of all targets.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from scipy import sparse

from trackmdp.arrays.entries import among, distinct, per_row
from trackmdp.arrays.types import Array, BoolArray, IndexArray
from trackmdp.errors import UserError
from trackmdp.policies.saved import packed
from trackmdp.policies.table import PolicyTable
from trackmdp.sensing.decisions import report_chance, sensing
from trackmdp.solvers.renewal import Renewal
from trackmdp.solvers.search import Found
from trackmdp.solvers.several.beliefs import Beliefs, Clocks
from trackmdp.world.group import Group

if TYPE_CHECKING:  # figures of a rule need no torch
    from tensordict import TensorDictBase

Reports: TypeAlias = tuple[BoolArray, BoolArray]
"""`[E, K]` each: whether a target is in the grid after the step, and whether it was located."""


class Rule(ABC):
    """A policy for several targets.

    Args:
        group: the targets.
        tables: the policy of a single target, for each of `group.kinds`.
    """

    name = ""
    reads_history = False
    """Whether it reads the sets of the last steps."""
    reads_beliefs = False
    """Whether it reads where the targets may be."""

    @property
    def remembers(self) -> bool:
        """Whether plans may remember more than the cell."""
        return False

    def __init__(self, group: Group, tables: Sequence[PolicyTable]) -> None:
        self.group, self.tables = group, tuple(tables)
        self.task = group.task
        self.cells, self.sensors = self.task.num_cells, self.task.total_sensors
        if tables and len(tables) != len(group.kinds):
            raise UserError(
                f"policy: number of plans {len(tables)}, expected {len(group.kinds)}, one for each motion"
            )
        for table in tables:
            table.check_fits(self.task)
            if not table.deterministic or (table.task.keyed and not self.remembers):
                raise UserError(
                    "policy: expected one that remembers the cell and does not draw, for several targets; on recorded "
                    "tracks targets.merge=union takes one that remembers more"
                )
        self.keys = self.tables[0].task.keys if self.tables else self.task.keys
        if any(table.task.keys != self.keys for table in self.tables):
            raise UserError(
                "policy: plans of different memories, expected the same for all targets"
            )

    def within(self, group: Group) -> Rule:
        """The same policy for other targets of the same task: the plans of their motions, or all in their order."""
        if group is self.group:
            return self
        known = dict(zip(self.group.kinds, self.tables, strict=True))
        kinds = group.kinds if known.keys() >= set(group.kinds) else self.group.kinds
        return type(self)(group, [known[kind] for kind in kinds])

    @property
    def keyed(self) -> bool:
        """Whether plans know more at a detection than the cell."""
        return self.keys.num_classes > 1

    def start(self, state: IndexArray, present: BoolArray | None = None) -> Clocks:
        """Targets of E episodes located in their `state` `[E, K]`: all, or those that are `present` `[E, K]`."""
        located, mode = self.group.cell_of(state), state % self.group.modes
        history = np.zeros((len(located), self.task.num_choices, self.sensors), bool)
        kept = history if self.reads_history else None
        here = np.ones(located.shape, bool) if present is None else present
        located = np.where(here, located, 0)
        key = self.keys.start(located, mode) if self.keyed else None
        return Clocks(located, np.zeros_like(located), here, kept, key)

    def keys_after(self, clocks: Clocks, state: IndexArray, seen: BoolArray) -> IndexArray | None:
        """`[E, K]` keys after a step in which the targets `seen` `[E, K]` were located in `state`, or have entered."""
        if clocks.key is None:
            return None
        place = self.group.cell_of(state), state % self.group.modes
        later = self.keys.next(clocks.key, clocks.misses, *place)
        later = np.where(clocks.present, later, self.keys.start(*place))
        return np.where(seen, later, clocks.key)

    def first_sets(self) -> list[sparse.csr_array]:
        """For each kind `[M, S]`, the set of a single target that is located."""
        rows = self.keys.start(np.arange(self.cells)) * self.task.num_choices
        return [table.written[rows] for table in self.tables]

    def own_sets(self, seen: Clocks) -> IndexArray:
        """As `sets`, each target's own set, all of them together."""
        free = seen.present & (seen.misses <= self.task.t_max)
        found = []
        for kind, table in enumerate(self.tables):
            episode, target = np.nonzero(free & (self.group.kind == kind))
            key = seen.located if seen.key is None else seen.key
            row = (key * self.task.num_choices + seen.misses)[episode, target]
            on = table.written[row].tocoo()
            found.append(episode[on.row] * self.sensors + on.col)
        return distinct(np.concatenate(found))

    def __call__(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write `action` `[*B, S]` bool, in the states that `TrackEnv` shows of the targets: a policy of TorchRL.

        No sensor is on where the safe action is due.

        Raises:
            UserError: it reads more than these states hold, or they are of other targets.
        """
        unseen = "the keys of its plans" if self.keyed else ""
        if self.reads_beliefs and not self.task.safe:
            unseen = "the steps in which the safe action missed"
        if unseen:
            raise UserError(f"policy: reads {unseen}, which TrackEnv does not show; simulate it")
        targets = len(self.group)
        shapes: dict[str, tuple[int, ...]] = {
            "last_cell": (targets,),
            "steps_since_detection": (targets,),
            "present": (targets,),
            "action_history": (self.task.num_choices, self.sensors),
        }
        parts = [tensordict.get(name, None) for name in shapes]
        each = list(zip(parts, shapes.values(), strict=True))
        if any(part is None or part.shape[-len(shape) :] != shape for part, shape in each):
            raise UserError(
                f"policy: expected {', '.join(shapes)}, as TrackEnv shows them of {targets} targets"
            )
        seen = Clocks(*(part.cpu().numpy().reshape(-1, *shape) for part, shape in each))
        moved = Beliefs.none()
        if self.reads_beliefs:
            moved = Beliefs.recalled(self.group, seen).moved(self.group)
        action = np.zeros((len(seen.present), self.sensors), bool)
        action.reshape(-1)[self.sets(seen, moved)] = True
        action[seen.late(self.task.t_max)] = False
        past = parts[-1]
        found = past.new_tensor(action).view(*past.shape[:-2], self.sensors)
        return tensordict.set("action", found)

    def packed(self) -> list[dict[str, Any]]:
        """The arrays from which it is made again, of each kind."""
        return [packed(table) for table in self.tables]

    @abstractmethod
    def sets(self, seen: Clocks, moved: Beliefs) -> IndexArray:
        """Sorted numbers e · S + j of the sensors j that are on in episode e.

        Args:
            seen: what the tracker is shown.
            moved: where the targets may be after the move.
        """


class Union(Rule):
    """Each target's own set, all of them together."""

    name = "union"

    @property
    def remembers(self) -> bool:
        """See `Rule`."""
        return self.group.recorded is not None or self.group.modes > 1

    def sets(self, seen: Clocks, moved: Beliefs) -> IndexArray:  # noqa: ARG002
        """See `Rule`."""
        return self.own_sets(seen)


class Merged(Rule):
    """Gains of all targets, added up for each sensor."""

    name = "gains"
    reads_beliefs = True

    @property
    def remembers(self) -> bool:
        """See `Rule`; the mode that a detection reveals, so that keys are states."""
        return self.group.hidden < self.group.modes

    @cached_property
    def _plans(self) -> tuple[Array, list[tuple[IndexArray, Array]]]:
        """`[Z]` V of all kinds; and for each n sorted numbers located · Z + state with W there."""
        states, each = self.group.kernel.shape[0], self.group.states
        values = []
        worths = [(list[IndexArray](), list[Array]()) for _ in range(self.task.num_choices)]
        # Plans are those of whole episodes, also where these are cut off.
        for kind, (world, table) in enumerate(zip(self.group.kinds, self.tables, strict=True)):
            renewal = Renewal(world.remembering(revealed=world.revealed), world.motion)
            try:
                policy = Found(renewal, renewal.sets(table))
            except UserError as error:  # the target never exits
                raise UserError(f"{error}, or max_steps and targets.merge=union") from None
            # Behind the states stand those in which the safe action has missed, if it does.
            values.append(policy.value[:each])
            after = policy.plans().after(policy.sets)
            for step, worth, (codes, found) in zip(renewal.free, after, worths, strict=True):
                located, state = step.rows + kind * each, step.states + kind * each
                codes.append(located.astype(np.int64) * states + state)
                found.append(worth[:, 0])
        return np.concatenate(values), [
            (np.concatenate(codes), np.concatenate(found)) for codes, found in worths
        ]

    def credit(self, located: IndexArray, misses: IndexArray, state: IndexArray) -> Array:
        """`[L]`, r + V - W of targets in `state`, last `located` in another one; 0 where no own move leads there."""
        value, worths = self._plans
        found, codes = np.zeros(len(state)), located * self.group.kernel.shape[0] + state
        for n, (known, worth) in enumerate(worths):
            now = np.flatnonzero(misses == n)
            place, there = among(known, codes[now])
            here = now[there]
            found[here] = self.task.reward + value[state[here]] - worth[place[there]]
        return found

    def sets(self, seen: Clocks, moved: Beliefs) -> IndexArray:
        """See `Rule`."""
        episodes, targets = seen.present.shape
        free = (seen.misses <= self.task.t_max).ravel()[moved.row]
        row, state = moved.row[free], moved.state[free]
        located, misses = seen.located if seen.key is None else seen.key, seen.misses.ravel()[row]
        located = located.ravel()[row] + self.group.kind[row % targets] * self.group.states
        cell, episode = self.group.cell_of(state), row // targets
        gain = moved.mass[free] * self.credit(located, misses, state)
        inside = per_row(moved.row, moved.mass, episodes * targets)
        gone = 1.0 - inside.reshape(episodes, targets)
        each = sensing(self.task, episode, cell, episodes)
        price = self.task.prices[each.sensors] * (1.0 - gone.prod(axis=1))[each.rows]
        codes, own = each.rows * self.sensors + each.sensors, None
        if self.task.coverage is not None:  # no worse, for these gains, than all own sets together
            own = among(self.own_sets(seen), codes)[1][:, None]
        return codes[each.best(gain[:, None], price[:, None], own)[:, 0]]


def make_rule(group: Group, tables: Sequence[PolicyTable], merge: str | None = None) -> Rule:
    """The policy for several targets that single ones make, merged by `gains`, or their plain `union`.

    None: by gains, but the union on recorded tracks, of which the moves pooled by cell say too little, with hidden
    modes, where a plan's worth is no sum over cells, and of one set for all that may be known, such as `none`, or all
    sensors: gains would make another policy of it. Else a budget needs gains.
    """
    kinds, limited = {"gains": Merged, "union": Union}, group.task.limited
    of_states = all(each.task.order == 0 and each.task.revealed == group.modes for each in tables)
    if merge is None:
        known = group.recorded is None and of_states
        merge = "gains" if (known or limited) and not _one_set(tables) else "union"
    if merge not in kinds:
        raise UserError(f"merge={merge}: expected gains or union")
    if merge == "gains" and group.modes > 1 and not of_states:
        raise UserError("targets.merge=gains: expected union, or plans of cell and revealed mode")
    if merge == "union" and limited and not _one_set(tables):
        raise UserError(f"targets.merge=union: expected gains with a budget, {group.task.budget}")
    return kinds[merge](group, tables)


def _one_set(tables: Sequence[PolicyTable]) -> bool:
    """Whether plans have one set in all states, or all sensors that can be chosen, with a window others in each."""
    if all(each.alike for each in tables):
        return len({each.sets.indices.tobytes() for each in tables}) == 1
    pairs = ((each.sets, each.all_on(each.task).sets) for each in tables)
    return all(sets.shape == every.shape and sets.nnz == every.nnz for sets, every in pairs)


def followed(
    rule: Rule, clocks: Clocks, moved: Beliefs, on: IndexArray, state: IndexArray, report: Reports
) -> tuple[Clocks, Beliefs]:
    """Clocks and beliefs after a step.

    Args:
        rule: the policy, and its targets.
        clocks: before the step.
        moved: beliefs after the move.
        on: sorted numbers e · S + j of the sensors j that were on in episode e.
        state: `[E, K]`, of the targets after the move; read where they were located.
        report: which targets are in the grid, and which were located.
    """
    task, (present, seen) = rule.task, report
    cell, episode = rule.group.cell_of(moved.state), moved.row // present.shape[1]
    late, missed = clocks.late(task.t_max), (present & ~seen).ravel()
    seen_with = report_chance(task, on, episode, cell)
    chance = np.where(late[episode], task.safe_detection[cell], seen_with)
    left = moved.given(missed, chance, missed.size)
    again = np.flatnonzero(seen.ravel())
    found = left.joined(moved.seen(rule.group, again, state.ravel()[again]))
    # A target that has left keeps no clock; one that the safe action missed is due for the next one.
    misses = np.where(present & ~seen, np.minimum(clocks.misses + 1, task.t_max + 1), 0)
    located = np.where(seen, rule.group.cell_of(state), clocks.located)
    history, key = clocks.remembered(on, late), rule.keys_after(clocks, state, seen)
    return Clocks(located, misses, present, history, key), found
