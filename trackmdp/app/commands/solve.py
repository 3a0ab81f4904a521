"""`solve`: solve the world with its motion model."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from trackmdp.app.commands.frontier import mixture_report, show_mixture, write_corners
from trackmdp.config import SolveConfig
from trackmdp.durable import write_json
from trackmdp.policies.saved import sets_name, write_sets
from trackmdp.solvers import bounds, rules
from trackmdp.solvers.evaluation import figures, regret_per_step
from trackmdp.solvers.frontier import trace
from trackmdp.solvers.hidden import averaged
from trackmdp.solvers.linear import DIRECT_CELLS
from trackmdp.solvers.partition import narrow_halo
from trackmdp.solvers.solution import Solution
from trackmdp.solvers.solve import run_solver, solve_group
from trackmdp.solvers.value import value_of
from trackmdp.training.display import make_console, reporting, table
from trackmdp.world.group import Group
from trackmdp.world.model import World
from trackmdp.world.problem import Problem, check_sensors, modelled

_MEAN_BUDGET = "mean_budget.json"
_BOUNDS = {"paper": bounds.paper, "valid": bounds.valid, "clocked": bounds.clocked}


def run(cfg: SolveConfig, folder: Path, problem: Problem) -> float:
    """Write `solution.json` (and `verification.json`) to `folder`; returns the AIHTR.

    Ctrl-C ends a search early: the bracket reached so far is printed and saved.
    """
    console = make_console(cfg.quiet)
    world = modelled(problem, "solve")
    if cfg.verify:
        check_sensors(world)
    if cfg.targets.count > 1:
        return _several(cfg, world, folder, console)
    with reporting(console, f"solve {cfg.solver.name}") as show:
        solution = run_solver(world, cfg.solver, show, cfg.partition)
    bound = {name: float(each(world).mean()) for name, each in _BOUNDS.items()}
    (folder / _MEAN_BUDGET).unlink(missing_ok=True)  # of another policy
    arrays = write_sets(folder, solution.table, value=solution.value, upper_value=solution.bound)
    write_json(folder / "solution.json", _report(cfg, solution, bound) | arrays)
    _show(console, cfg.solver.name, world, solution, bound, folder)
    if (most := getattr(cfg.cost, "mean_budget", None)) is not None and not solution.interrupted:
        _on_average(console, cfg, world, solution, most, folder)
    found = solution.evaluation
    warning = narrow_halo(world, cfg.partition, solution.upper, found)
    if warning:
        console.print(f"warning: {warning}")
    # After the results are written: the command still ends with the status of an interruption.
    if solution.interrupted:
        raise KeyboardInterrupt
    if cfg.verify:
        from trackmdp.app.commands.verify import verify_world  # loads the package `paper`

        verify_world(world, 1e-9, folder, console)
    return solution.lower


def _several(cfg: SolveConfig, world: World, folder: Path, at: Console) -> float:
    """Write `solution.json` and the sets of a single target; returns the AIHTR of separate trackers."""
    with reporting(at, f"solve {cfg.solver.name}") as show:
        found = solve_group(Group([world] * cfg.targets.count), cfg.solver, show, cfg.partition)
    single, steps = found.singles[0], found.group.expected_steps
    arrays = write_sets(folder, single.table, value=single.value)
    own = {"targets": cfg.targets.count, "apart": found.apart, "lower": found.lower}
    own |= {"upper": found.upper, "expected_length": steps, "seconds": found.seconds}
    write_json(folder / "solution.json", {"solver": cfg.solver.name} | own | arrays)
    rows = [
        ["one target", f"{single.lower:,.6f}"],
        ["as many separate trackers", f"{found.apart:,.6f}"],
    ]
    if found.lower is not None:
        rows.append(["proved: the best policy, at least", f"{found.lower:,.6f}"])
    rows.append(["proved bound on all policies", f"{found.upper:,.6f}"])
    at.print(table(f"{cfg.targets.count} targets", ["", "AIHTR"], rows))
    gap = (found.upper - found.apart) / steps
    at.print(
        f"separate trackers are {gap:.2g} per step below the bound; {found.seconds:.1f} s; results in {folder}, sets "
        f"of one target in {sets_name(single.table)}; evaluate baseline=optimal values them merged"
    )
    if single.interrupted:
        raise KeyboardInterrupt
    return found.apart


def _report(cfg: SolveConfig, solution: Solution, bound: dict[str, float]) -> dict[str, Any]:
    own = ("lower", "upper", "certified", "interrupted", "timed_out", "seconds", "nodes")
    return {
        "solver": cfg.solver.name,
        **{name: getattr(solution, name) for name in own},
        "regret_per_step": regret_per_step(solution.upper, solution.evaluation),
        "figures": figures(solution.evaluation),
        "bounds": bound,
    }


def _show(
    at: Console,
    name: str,
    world: World,
    solution: Solution,
    bound: dict[str, float],
    folder: Path,
) -> None:
    found = {solution.title if name == "optimal" else name: solution.evaluation}
    # Where it senses little it is a matter of minutes on a large grid; `evaluate baseline=qmdp` values it there.
    if world.num_cells <= DIRECT_CELLS:
        found["Q_MDP"] = value_of(world, rules.qmdp(averaged(world)))
    rows = [
        [
            name,
            f"{e.aihtr:,.6f}",
            f"{100 * e.accuracy:.2f} %",
            f"{e.sensors_per_step:.3f}",
            f"{e.safe_per_episode:.3f}",
        ]
        for name, e in found.items()
    ]
    called = {"paper": "printed"}  # as reports call it
    rows += [
        [f"{called.get(name, name)} bound", f"{value:,.6f}", "", "", ""]
        for name, value in {"proved": solution.upper, **bound}.items()
    ]
    columns = ["policy", "AIHTR", "accuracy", "sensors per step", "safe per episode"]
    at.print(table("exact values", columns, rows))
    regret = max(regret_per_step(solution.upper, solution.evaluation), 0.0)
    at.print(
        f"{solution.ended}: bracket {solution.lower:,.6f} ... {solution.upper:,.6f}, {regret:.2g} per step, after "
        f"{solution.seconds:.1f} s and {solution.nodes:,} nodes; results in {folder}, sets in "
        f"{sets_name(solution.table)}"
    )


def _on_average(
    at: Console, cfg: SolveConfig, world: World, solution: Solution, most: float, folder: Path
) -> None:
    """The best policies with `most` sensors per step on average: `mean_budget.json`, and the sets of the corners."""
    path, price = folder / _MEAN_BUDGET, float(np.nanmin(world.cost))
    if solution.evaluation.sensors_per_step <= most:
        write_json(path, {"sensors": most, "binding": False})
        at.print(f"cost.mean_budget={most:g}: the policy above has fewer sensors per step")
        return
    with reporting(at, f"cost.mean_budget={most:g}") as show:
        found = trace(world, cfg.solver, 1e-3, show, most)
    if found.interrupted and found.corners[0].sensors > most:
        raise KeyboardInterrupt  # no two policies around it yet
    mixture = found.at(sensors=most)
    value = sum(weight * value_of(world, each.table).aihtr for weight, each in mixture.parts)
    # The bound on policies of any number of sensors may be the smaller one where a search was cut.
    upper = max(value, min(found.worth(most, price), solution.upper))
    own = {"sensors": most, "binding": True, "lower": value, "upper": upper}
    write_json(path, own | mixture_report(mixture, found))
    write_corners(folder / "mean_budget", found)
    show_mixture(at, f"cost.mean_budget={most:g}", mixture, found)
    at.print(
        f"mixture: AIHTR {value:,.6f}, no policy with as few sensors has more than {upper:,.6f}"
    )
    if found.interrupted:
        raise KeyboardInterrupt
