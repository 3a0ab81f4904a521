"""One verb for every solver, by name: of this package and of installed plugins."""

from __future__ import annotations

import time
import warnings
from functools import partial
from inspect import signature
from typing import TYPE_CHECKING, Any, overload

from trackmdp.config.baselines import BaselineConfig
from trackmdp.config.by_blocks import SweptPartitionConfig
from trackmdp.config.compose import compose, default, given
from trackmdp.config.registry import make, maker
from trackmdp.policies.table import PolicyTable
from trackmdp.solvers.linear import DIRECT_CELLS
from trackmdp.solvers.partition import blocks, narrow_halo, plan_by_blocks
from trackmdp.solvers.regions import settled
from trackmdp.solvers.several.group_bounds import upper_bound
from trackmdp.solvers.several.group_solution import GroupSolution
from trackmdp.solvers.solution import OnProgress, Solution, bracketed
from trackmdp.solvers.workers import Crew, crew
from trackmdp.world.group import Group, check_problem
from trackmdp.world.model import World
from trackmdp.world.problem import Problem, modelled

if TYPE_CHECKING:  # torch is loaded where a policy is to act
    from trackmdp.policies.policy import Policy

_SWEEPS = 10
"""Rounds over the whole grid after the blocks, at most: two or three change anything."""


@overload
def solve(world: World, solver: str = ..., **options: Any) -> Solution: ...
@overload
def solve(world: Group, solver: str = ..., **options: Any) -> GroupSolution: ...


def solve(
    world: World | Group,
    solver: str = default("solver", "solve"),
    *,
    nodes: int = default("solver.nodes", "solve"),
    time_limit: float | None = default("solver.time_limit", "solve"),
    on_progress: OnProgress = None,
    block: int | None = default("partition.block", "solve"),
    halo: int | None = default("partition.halo", "solve"),
    workers: int = default("partition.workers", "solve"),
    sweeps: int | None = default("partition.sweeps", "solve"),
    **options: Any,
) -> Solution | GroupSolution:
    """The policy that a solver finds for `world`, its figures, and an upper bound for every policy.

    Defaults and checks are the same as of ``trackmdp solve``.

    Args:
        world: the problem with its motion model. With hidden modes `optimal` searches over keys of `world.memory`, and
            the others take the next move to depend on the cell alone, as it does on average. Of a `Group` each target
            is solved for by itself, and a bound for all together is proved.
        solver: ``optimal``, ``clocked``, ``qmdp``, ``fcr``, ``lookahead``, or one of an installed plugin.
        nodes: work after which `optimal` stops closing the bracket, the same on every machine.
        time_limit: seconds after which it stops even so; None: never. Neither is an option of the others.
        on_progress: called with the progress of a search, about once a second.
        block: side of the blocks that plan for themselves (`trackmdp.solvers.partition`); None: the whole grid at once.
        halo: cells around its own that a block knows of; None: as many as lose nothing.
        workers: processes that plan blocks; the result does not depend on it.
        sweeps: rounds of exchange over the whole grid after the blocks; None: until no value grows, at most 10, with
            the default halo, and none with a halo of its own.
        **options: the solver's own, such as ``depth=3`` (``trackmdp solve --help`` lists them).

    Raises:
        UserError: a name, a type or a range is wrong, or the target of the world never exits.

    Example:
        >>> from trackmdp.world.make import make_world
        >>> solution = solve(make_world("drift", size=4))
        >>> solution.certified and solution.upper - solution.lower < 1e-6 * abs(solution.upper)
        True
    """
    check_problem(world, "solve")
    own = {f"solver.{name}": value for name, value in options.items()}
    named = given({"solver": solver, "solver.nodes": nodes, "solver.time_limit": time_limit})
    of_blocks = {"block": block, "halo": halo, "workers": workers, "sweeps": sweeps}
    cfg = compose(
        "solve",
        named | own | given({f"partition.{name}": value for name, value in of_blocks.items()}),
    )
    modelled(world.single, f"solver={cfg.solver.name}")
    if isinstance(world, Group):
        return solve_group(world, cfg.solver, on_progress, cfg.partition)
    solution = run_solver(world, cfg.solver, on_progress, cfg.partition)
    said = narrow_halo(world, cfg.partition, solution.upper, solution.evaluation)
    if said:
        warnings.warn(said, stacklevel=2)
    return solution


def run_solver(
    world: World,
    choice: BaselineConfig,
    on_progress: OnProgress = None,
    partition: SweptPartitionConfig | None = None,
    start: PolicyTable | None = None,
) -> Solution:
    """The policy of a config's solver; one without a proof is bracketed by the clocked bound.

    From `start`, a known policy, those solvers begin that take one; the policy is then no worse.
    """
    blind = not world.tells_all or (world.modes > 1 and choice.name != "optimal")
    if blind and (partition is None or partition.block is None):
        return _modes(world, choice, start, on_progress)
    # Where the state is known at a detection, more of the past is of no use.
    if not blind and world.memory != "cell":
        world = world.but(memory="cell")
    started = time.monotonic()
    if partition is not None and partition.block is not None:
        workers = min(partition.workers, len(blocks(world.size, partition.block, halo=0)))
        with crew(workers, partition.cluster) as run:
            start = by_blocks(world, choice, partition, run)
        found = bracketed(world, start, time.monotonic() - started)
        if blind or found.certified or not _closes(world, choice, partition):
            return found
    taken = signature(maker(choice)).parameters
    offered: dict[str, Any] = {"on_progress": on_progress}
    if start is not None:
        offered["start"] = start
    made = make(choice, world, **{name: each for name, each in offered.items() if name in taken})
    return (
        made if isinstance(made, Solution) else bracketed(world, made, time.monotonic() - started)
    )


def _closes(world: World, choice: BaselineConfig, partition: SweptPartitionConfig) -> bool:
    """Whether the whole grid is searched from the plan of its blocks where this does not attain the clocked bound.

    Not so with a halo of its own, which shows its loss, and where one search of all cells takes too much.
    """
    whole = partition.halo is None and partition.sweeps != 0
    return choice.name == "optimal" and whole and world.num_states <= DIRECT_CELLS


def solve_group(
    group: Group,
    choice: BaselineConfig,
    on_progress: OnProgress,
    partition: SweptPartitionConfig,
) -> GroupSolution:
    """Plans of single targets by a config's solver, and the bound for all of them together."""
    started = time.monotonic()
    singles = tuple(run_solver(world, choice, on_progress, partition) for world in group.kinds)
    upper = upper_bound(group)
    return GroupSolution(group, singles, upper, time.monotonic() - started)


def _modes(
    world: World,
    choice: BaselineConfig,
    start: PolicyTable | None,
    on_progress: OnProgress,
) -> Solution:
    """As `run_solver`, where modes are hidden, or the solver does not read them."""
    from trackmdp.solvers import hidden

    if choice.name == "optimal":
        return hidden.solve(world, start=start, on_progress=on_progress, **vars(choice))
    started = time.monotonic()
    made = make(choice, hidden.averaged(world))
    table = made.table if isinstance(made, Solution) else made
    return bracketed(world, table, time.monotonic() - started)


def by_blocks(
    world: World, choice: BaselineConfig, partition: SweptPartitionConfig, run: Crew
) -> PolicyTable:
    """The policy that `run` plans block by block and, with ``solver=optimal``, settles over the whole grid."""
    from trackmdp.solvers.hidden import averaged

    assert partition.block is not None
    # How often each mode occurs is known of the whole grid.
    world = world if choice.name == "optimal" else averaged(world)
    # Other solvers' plans stay as they are, so a narrow halo shows its loss, unless asked otherwise.
    sweeps = (
        (_SWEEPS if partition.halo is None else 0) if partition.sweeps is None else partition.sweeps
    )
    table = plan_by_blocks(world, partial(_planned, choice), partition.block, partition.halo, run)
    # With modes the regions that settle would have to know them.
    settles = choice.name == "optimal" and world.modes == 1
    return settled(world, table, partition.block, sweeps, run) if settles else table


def _planned(choice: BaselineConfig, number: int, world: World) -> PolicyTable:  # noqa: ARG001
    """The policy that a solver of the config finds for a block."""
    return run_solver(world, choice).uninterrupted().table


def baseline_policy(problem: Problem, choice: BaselineConfig) -> Policy:
    """The policy of a fixed rule or of a solver.

    Against targets with a mode `optimal` solves over keys; the other solvers take the next move to depend on the cell
    alone, as it does on average (`averaged`).

    Raises:
        UserError: it needs a motion model, and recorded tracks have none.
        KeyboardInterrupt: Ctrl-C ended its search, whose policy so far is not the baseline.
    """
    from trackmdp.policies.policy import as_policy

    if not choice.without_motion:
        world = modelled(problem, f"baseline={choice.name}")
        if choice.whole_episodes and world.max_steps is not None:
            world = world.but(max_steps=None)
        return run_solver(world, choice).uninterrupted().policy
    made = make(choice, problem)
    return made.policy if isinstance(made, Solution) else as_policy(problem, made)


def named_policy(problem: Problem, name: str) -> Policy:
    """The policy of a baseline by its name, with the options of `conf/`.

    Raises:
        UserError: there is no such baseline, it needs an option, or a motion model that the problem does not have.
    """
    return baseline_policy(problem, compose("evaluate", {"baseline": name}).baseline)
