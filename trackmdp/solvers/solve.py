"""One verb for every solver, by name: those of this package and those of installed plugins."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from inspect import signature
from typing import TYPE_CHECKING, Any

from trackmdp.config.baselines import BaselineConfig
from trackmdp.config.compose import compose, default, given
from trackmdp.config.partition import SweptPartitionConfig
from trackmdp.config.registry import make, maker
from trackmdp.errors import UserError
from trackmdp.policies.table import PolicyTable
from trackmdp.solvers.keyed import averaged
from trackmdp.solvers.keyed_search import solve_keys
from trackmdp.solvers.partition import blocks, narrow_halo, plan_by_blocks
from trackmdp.solvers.regions import settled
from trackmdp.solvers.solution import SearchProgress, Solution, bracketed
from trackmdp.solvers.workers import Crew, crew
from trackmdp.world.model import World
from trackmdp.world.modes import HiddenWorld, Modelled
from trackmdp.world.tracks import Problem

if TYPE_CHECKING:  # torch is loaded where a policy is to act
    from trackmdp.policies.policy import Policy

_SWEEPS = 10
"""Rounds over the whole grid after the blocks, at most: two or three change anything."""


def solve(
    world: Modelled,
    solver: str = default("solver", "solve"),
    *,
    nodes: int = default("solver.nodes", "solve"),
    time_limit: float | None = default("solver.time_limit", "solve"),
    on_progress: Callable[[SearchProgress], None] | None = None,
    block: int | None = default("partition.block", "solve"),
    halo: int | None = default("partition.halo", "solve"),
    workers: int = default("partition.workers", "solve"),
    sweeps: int | None = default("partition.sweeps", "solve"),
    **options: Any,
) -> Solution:
    """The policy that a solver finds for `world`, what it earns, and an upper bound on what any policy earns.

    The defaults are those of `conf/`, the checks those of ``trackmdp solve``.

    Args:
        world: the problem with its motion model. With a hidden mode the policy remembers what `world.memory` says, and
            is found by policy iteration over keys, whatever the solver.
        solver: ``optimal``, ``clocked``, ``qmdp``, ``fcr``, ``lookahead``, or one of an installed plugin.
        nodes: work after which `optimal` stops closing the bracket, the same on every machine.
        time_limit: seconds after which it stops even so; None: never. Neither is an option of the others.
        on_progress: told how far a search has come, about once a second.
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
    own = {f"solver.{name}": value for name, value in options.items()}
    named = given({"solver": solver, "solver.nodes": nodes, "solver.time_limit": time_limit})
    of_blocks = {"block": block, "halo": halo, "workers": workers, "sweeps": sweeps}
    cfg = compose("solve", named | own | given({f"partition.{name}": value for name, value in of_blocks.items()}))
    solution = run_solver(world, cfg.solver, on_progress, cfg.partition)
    if isinstance(world, World) and (said := narrow_halo(world, cfg.partition, solution.upper, solution.evaluation)):
        warnings.warn(said, stacklevel=2)
    return solution


def run_solver(
    world: Modelled,
    choice: BaselineConfig,
    on_progress: Callable[[SearchProgress], None] | None = None,
    partition: SweptPartitionConfig | None = None,
) -> Solution:
    """What the solver of a config finds; a policy without a proof is bracketed by the clocked bound."""
    if isinstance(world, HiddenWorld):
        return solve_keys(world)
    if not isinstance(world, World):
        raise UserError(f"solver={choice.name}: needs a motion model; recorded tracks have none")
    if world.coverage is not None and partition is not None and partition.block is not None:
        raise UserError(f"partition.block={partition.block}: expected null with sensors that have footprints")
    started = time.monotonic()
    if partition is not None and partition.block is not None:
        workers = min(partition.workers, len(blocks(world.size, partition.block, halo=0)))
        with crew(workers, partition.cluster) as run:
            table = by_blocks(world, choice, partition, run)
        return bracketed(world, table, time.monotonic() - started)
    watched = {"on_progress": on_progress} if "on_progress" in signature(maker(choice)).parameters else {}
    made = make(choice, world, **watched)
    return made if isinstance(made, Solution) else bracketed(world, made, time.monotonic() - started)


def by_blocks(world: World, choice: BaselineConfig, partition: SweptPartitionConfig, run: Crew) -> PolicyTable:
    """The policy that `run` plans block by block and, with ``solver=optimal``, settles over the whole grid."""
    assert partition.block is not None
    # Other solvers' plans are what they are; what a narrow halo loses stays to be seen, unless asked otherwise.
    sweeps = (_SWEEPS if partition.halo is None else 0) if partition.sweeps is None else partition.sweeps
    table = plan_by_blocks(world, _Planner(choice), partition.block, partition.halo, run)
    return settled(world, table, partition.block, sweeps, run) if choice.name == "optimal" else table


@dataclass(frozen=True)
class _Planner:
    """The policy that a solver of the config finds for a block; picklable, to be sent to workers."""

    choice: BaselineConfig

    def __call__(self, number: int, world: World) -> PolicyTable:  # noqa: ARG002
        return run_solver(world, self.choice).table


def baseline_policy(problem: Problem, choice: BaselineConfig) -> Policy:
    """The policy of a fixed rule or of a solver.

    Against targets with a mode `optimal` solves over keys; the other solvers take the next move to depend on the cell
    alone, as it does on average (`averaged`).

    Raises:
        UserError: it needs a motion model, and recorded tracks have none.
    """
    from trackmdp.policies.policy import as_policy

    if isinstance(problem, HiddenWorld) and choice.reads_motion:
        if choice.name == "optimal":
            return solve_keys(problem).policy
        problem = averaged(problem)
    if choice.reads_motion and not isinstance(problem, World):
        raise UserError(f"baseline={choice.name}: needs a motion model; recorded tracks have none")
    if choice.whole_episodes:
        problem = replace(problem, max_steps=None)
    made = make(choice, problem)
    return made.policy if isinstance(made, Solution) else as_policy(problem, made)
