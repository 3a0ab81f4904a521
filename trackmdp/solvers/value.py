"""The exact value of a policy: its renewals, then one linear system over the events (theory.md#exact-value).

After a miss the next state is known in advance, so a policy is, for each key, the plan of sets it senses at n = 0 ...
t_max misses. Pushing the undetected mass along the plans gives, for each event, the expected reward until the next one,
b, and its place, K; then V = (I - K)^-1 b. The same holds with a motion model and on recorded tracks, whose states
are their points.

Where episodes of a model are truncated after `max_steps` steps, values depend on the steps left, so the linear solve
becomes a backward recursion over them. Nothing diverges where the target never exits.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy import sparse

from trackmdp.arrays.entries import per_row
from trackmdp.arrays.types import Array, BoolArray, IndexArray
from trackmdp.errors import UserError
from trackmdp.motion.chain import Motion
from trackmdp.policies.table import PolicyTable, SetTable
from trackmdp.recordings.tracks import Recorded, Tracks
from trackmdp.sensing.task import Task
from trackmdp.solvers.evaluation import Evaluation, ReplayedTracks, by_start, pooled
from trackmdp.solvers.events import Events, started
from trackmdp.solvers.linear import DIRECT_CELLS, RenewalSystem, solve_onward
from trackmdp.solvers.mass import Passed, passed, passed_last
from trackmdp.solvers.motion_totals import check_length, expected_steps, still_to_come
from trackmdp.solvers.walk import Walk, all_events
from trackmdp.world.model import World
from trackmdp.world.problem import Problem

if TYPE_CHECKING:  # torch is loaded where something that acts is asked for its sets
    from trackmdp.policies.policy import PolicyLike

_MOST_GROUPS, _EVENTS_A_GROUP = 1_500, 4
"""States up to which each is a group of its own, and events a state from which: else factors cost more than they
spare."""
_AT_ONCE = 2**14
"""Events that are followed at once: on a million cells all together would take gigabytes."""


def value_of(
    problem: Problem,
    policy: PolicyLike | Array | BoolArray,
    *,
    guess: Array | None = None,
) -> Evaluation:
    """The figures of a policy of one target; `trackmdp.solvers.evaluate` takes names and several targets as well.

    Args:
        problem: a `World`, whose episodes end by the target's exit or after `max_steps`; or `Recorded` tracks.
        policy: a `Policy` or its table, or the same dense, `[M, t_max + 1, M]`; a TensorDict module or a function
            that does not draw (`Policy.from_function`); a `Run`, a `Solution`, or a model of Stable-Baselines3.
        guess: `[M]`, where the solve begins on a grid too large to factorise, such as the clocked bound.

    Raises:
        UserError: the policy draws at random with unknown probabilities, or is for another grid.
    """
    table = as_table(problem, policy)
    check_revealed(problem.motion, table)
    if isinstance(problem, Recorded):
        tracks = problem.held_out.limited(problem.max_steps)
        starts = tracks.cells[tracks.first[:-1]]
        return replay(problem, tracks, table).evaluation(starts, problem.num_cells)
    if problem.max_steps is not None:
        return truncated_value(problem, table, problem.max_steps)
    return _whole_episodes(problem, table, guess)


def follow(task: Task, motion: Motion, policy: PolicyTable) -> tuple[Events, Iterator[Passed]]:
    """The events that a policy leads to, and their steps: only mass that it leaves undetected is followed."""
    acts = policy.sensed_by(task)
    events = all_events(task, policy.task.keys, motion, acts.reports)
    return events, _steps(task, motion, events, acts)


def _renewals(
    task: Task, motion: Motion, policy: PolicyTable
) -> tuple[Events, sparse.csr_array, Array]:
    """The events that a policy leads to, K `[B, B]` and the totals `[B, 6]`; some events at a time."""
    acts, found = policy.sensed_by(task), list[tuple[sparse.csr_array, Array]]()
    events = all_events(task, policy.task.keys, motion, acts.reports)
    for begin in range(0, len(events.codes), _AT_ONCE):
        some = replace(events, codes=events.codes[begin : begin + _AT_ONCE])
        found.append(whole_renewals(_steps(task, motion, some, acts, events)))
    if len(found) == 1:
        return events, *found[0]
    located, gathered = zip(*found, strict=True)
    return events, sparse.vstack(located, "csr"), np.concatenate(gathered)


def _steps(
    task: Task, motion: Motion, events: Events, policy: SetTable, every: Events | None = None
) -> Iterator[Passed]:
    walk, key = Walk(task, motion, events, every=every), events.key
    mass = np.ones(len(events.codes) - events.forced)
    for n in range(task.num_choices):
        step = walk.move()
        report = policy.reports(n, key[step.rows], motion.cell[step.states])
        spent, sensors = (
            policy.spent(n, each)[key] for each in (task.paid, task.available.astype(np.float64))
        )
        found, mass = passed(task, step, mass, report, spent, sensors)
        yield found
        # Kept while the next one is made, it would be a tenth of the memory at a million cells.
        del found
        walk.keep(report < 1.0)
    yield passed_last(task, motion, walk.move(), mass)


def truncated_value(world: World, policy: PolicyTable, max_steps: int) -> Evaluation:
    """The figures of `value_of` for episodes of at most `max_steps` steps.

    With h steps left, V_h = Σ_t [b_t + L_t V_{h-t}] over the steps t = 1 ... min(h, t_max + 2) after a detection:
    b_t is gathered at step t, and L_t is the distribution of the target if located at step t. The last t_max + 2 V_h
    are kept.
    """
    events, found = follow(world, world.motion, policy)
    steps = _by_length(events, found)
    left = [np.zeros_like(steps[0][1])]  # V_{h-1}, V_{h-2}, ...
    for h in range(1, max_steps + 1):
        # zip stops at the shorter one: with h steps left only the first h steps of a renewal happen.
        now = sum(
            earned + hit @ later for (hit, earned), later in zip(steps[:h], left, strict=False)
        )
        # V_h is made of the t_max + 2 before it alone: where it is the same as they are, so are all that follow.
        if len(left) == len(steps):
            changes = zip([now, *left], left, strict=False)
            change = max(float(np.abs(after - before).max()) for after, before in changes)
            error = still_to_come(world, change, float(np.abs(now).max()), max_steps - h)
            if error is not None:
                return _figures(world, events, now, error)
        left = [np.asarray(now), *left[: len(steps) - 1]]
    return _figures(world, events, left[0])


def _by_length(events: Events, found: Iterable[Passed]) -> list[tuple[sparse.csr_array, Array]]:
    """L_t and b_t of t = 1 ... t_max + 2 steps after each event."""
    steps = [(each.located, each.totals) for each in found]
    if events.forced:
        # Another safe action is the first step after a miss of one, and the last step after a detection.
        count = len(events.codes)
        begun = sparse.diags_array((np.arange(count) >= count - events.forced).astype(np.float64))
        parts = [begun @ steps[-1][0], begun @ steps[-1][1]]
        steps[0] = (steps[0][0] + parts[0], steps[0][1] + parts[1])
        steps[-1] = (steps[-1][0] - parts[0], steps[-1][1] - parts[1])
    return steps


def _whole_episodes(world: World, policy: PolicyTable, guess: Array | None) -> Evaluation:
    events, located, gathered = _renewals(world, world.motion, policy)
    cells_alone = events.keys.num_classes == world.modes == 1
    if cells_alone and len(events.codes) > DIRECT_CELLS:
        return _iterated(world, located, gathered, guess)
    size = world.size if cells_alone else event_groups(world.motion, events.state)
    system = RenewalSystem(located, size)
    totals = system.solve(gathered)
    check_length(totals[:, 5])
    error = system.error(gathered, totals, float(totals[:, 5].max()))
    return _figures(world, events, totals, error)


def whole_renewals(steps: Iterable[Passed]) -> tuple[sparse.csr_array, Array]:
    """K `[B, width]` and the totals of whole renewals, `[B, 6]` as those of the steps."""
    each = iter(steps)
    first = next(each)
    located, gathered = first.located, first.totals
    del first  # as in `_steps`
    for step in each:
        located = located + step.located
        gathered = gathered + step.totals
        del step
    return located, gathered


def _iterated(
    world: World,
    located: sparse.csr_array,
    gathered: Array,
    guess: Array | None,
) -> Evaluation:
    """The figures on a large grid: by iteration, the value and the pooled figures by two solves in place of six."""
    m, states = world.num_cells, len(gathered)
    system, length = RenewalSystem(located, world.size), expected_steps(world)
    # The value of a missed target is near to the value of a located one in its cell.
    value = system.solve(gathered[:, 0], None if guess is None else np.tile(guess, states // m))
    # The steps are those of I - P, themselves iterated (theory.md#exact-value).
    error = system.error(gathered[:, 0], value, float(length.max()))
    # Sensing does not move the target, and each episode has one exit step: the steps in the grid are all but that one.
    steps = length - 1.0
    # Detections and the like are wanted for a uniform start s alone, s (I - T)^-1 b: with the visits v = s (I - T)^-1,
    # that is v = s + v T, each is a scalar product v b. One system goes before the next comes: both are large.
    del system
    system = RenewalSystem(sparse.csr_array(located.T), world.size)
    visits = system.solve(np.concatenate([np.full(m, 1 / m), np.zeros(states - m)]))
    return pooled([value[:m], steps, *(visits @ gathered[:, 2:5]), length], error)


def _figures(world: World, events: Events, totals: Array, error: float = 0.0) -> Evaluation:
    """The figures of all starts together, and by start cell; `totals` is `[B, 6]` of the rest of an episode."""
    motion = world.motion
    first = first_events(events, motion)
    return by_start(motion.cell[motion.first], totals[first], world.num_cells, error)


def first_events(events: Events, motion: Motion) -> IndexArray:
    """`[F]`, the event with which each of the F episodes starts."""
    return np.searchsorted(events.codes, started(events.keys, motion, motion.first))


def event_groups(motion: Motion, states: IndexArray) -> IndexArray:
    """`[B]`, 0 to the number of groups - 1: events of one state are a group, or of one cell.

    What follows an event depends on its key only until the next detection, so that a correction that is constant on
    each state leaves little to iterate: a third of the products with groups of a cell (heading, displacement_gap).
    """
    most = min(_MOST_GROUPS, len(states) // _EVENTS_A_GROUP)
    each = states if motion.num_states <= most else motion.cell[states]
    rank = np.cumsum(np.bincount(each) > 0) - 1
    return rank[each]


def visits_of(system: RenewalSystem, start: Array, guess: Array | None = None) -> Array:
    """`[B]` expected visits of each event in an episode, s (I - K)^-1.

    `guess` is where an iteration begins; None: a few detections after the start. Start keys are never revisited, so
    that from the start itself BiCGSTAB's first residual would be orthogonal to its shadow and break down.
    """
    if guess is None:
        guess = start
        for _ in range(4):
            guess = start + system.passed_on(guess)
    return system.solve(start, guess, transposed=True)


def key_visits(problem: Problem, policy: PolicyTable) -> Array:
    """`[keys]`, how often an episode's start or a detection leaves each key of a policy, expected."""
    motion = problem.motion
    events, located, _ = _renewals(problem, motion, policy)
    start = np.bincount(first_events(events, motion), minlength=len(events.codes))
    system = RenewalSystem(located, event_groups(motion, events.state))
    visits = visits_of(system, start / len(motion.first))
    known = len(events.codes) - events.forced
    return per_row(events.key[:known], visits[:known], events.keys.num_keys)


def price_at_exit(world: World, policy: PolicyTable) -> float:
    """Expected price of what is on, or due, on the exit step, free for a single target; starts are uniform."""
    events, found = follow(world, world.motion, policy)
    steps = list(found)
    located, _ = whole_renewals(steps)
    prices = [policy.spent(n, world.paid)[events.key] for n in range(world.num_choices)]
    prices.append(np.full(len(events.codes), world.safe_cost))
    exits = [step.totals[:, 5] - step.totals[:, 1] for step in steps]
    paid = (np.stack(prices) * np.stack(exits)).sum(axis=0)
    size = world.size if world.modes == 1 else event_groups(world.motion, events.state)
    return float(RenewalSystem(located, size).solve(paid).mean())


def replay(task: Task, tracks: Tracks, policy: PolicyTable) -> ReplayedTracks:
    """Follow `policy` along every recorded track, from its first cell.

    A renewal leads to later points of its track alone.
    """
    motion = tracks.motion()
    events, found = follow(task, motion, policy)
    steps, count = list(found), len(events.codes)
    located, gathered = whole_renewals(steps)
    place = tracks.places[events.state]
    totals = solve_onward(place, located, gathered)
    first = first_events(events, motion)
    start = np.bincount(first, minlength=count).astype(np.float64)
    visits = solve_onward(place, located, start, transposed=True)
    # How often each row of the policy's table was used, key by key and n by n.
    used = np.zeros((policy.task.num_keys, task.num_choices))
    for n, step in enumerate(steps[:-1]):
        used[:, n] = per_row(events.key, visits * step.totals[:, 1], len(used))
    each = totals[first]
    return ReplayedTracks(each[:, :5], each[:, 5], policy.watched(used.ravel()))


def check_revealed(motion: Motion, policy: PolicyTable) -> None:
    """See that a policy that knows modes apart at a detection can act on targets of this `motion`.

    Raises:
        UserError: the targets have other modes, or none.
    """
    if policy.task.revealed not in (1, motion.modes):
        raise UserError(
            f"policy: made for targets with {policy.task.revealed} modes; expected {motion.modes}"
        )


def as_table(problem: Problem, policy: PolicyLike | Array | BoolArray) -> PolicyTable:
    """The table of a policy in any form but a name; torch is loaded only for modules and functions."""
    if isinstance(policy, PolicyTable):
        policy.check_fits(problem)
        return policy
    if isinstance(policy, np.ndarray):
        return PolicyTable.from_dense(problem, policy)
    from trackmdp.policies.policy import as_policy

    return as_policy(problem, policy)
