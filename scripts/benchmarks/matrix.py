"""Every learner on every kind of world: regret to the best policy known, and CPU seconds."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

import trackmdp as tm
from benchmarks.words import Row
from trackmdp.errors import UserError

LEARNERS = ("model_based", "hindsight", "a2c_per_sensor", "ppo_per_sensor", "dqn_per_sensor")
JOINT = ("a2c", "ppo", "dqn")
"""Learners with joint credit, which take half a minute and more for a run."""


def rows(
    words: Mapping[str, str],  # noqa: ARG001
    algos: tuple[str, ...] = (*LEARNERS, *JOINT),
    seeds: tuple[int, ...] = (0, 1, 2),
    worlds: tuple[str, ...] = (),
    size: int = 4,
    hidden_size: int = 3,
    device: str = "cpu",
) -> Iterator[Row]:
    """One row for each world and learner, with joint credit of the first seed alone; `worlds` are parts of their names.

    `mean` and `worst` are regrets per step to the best policy known: of the solver, or of a run. `solver` is the regret
    of the solver's policy to it. A learner that refuses a world has its message in place of figures.
    """
    for name, case in cases(size, hidden_size).items():
        if worlds and not any(word in name for word in worlds):
            continue
        world, problem = case.made()
        began = time.process_time()
        best = known(world)
        seconds = time.process_time() - began
        found = {
            algo: runs_of(world, problem, algo, seeds[:1] if algo in JOINT else seeds, device)
            for algo in algos
        }
        values = [best, *(value for each in found.values() for value in each["values"])]
        most = max(values)
        for algo, each in found.items():
            regret = (most - np.array(each.pop("values"))) / each["steps"]
            yield {
                "world": name,
                "algo": algo,
                "mean": float(regret.mean()) if len(regret) else np.nan,
                "worst": float(regret.max()) if len(regret) else np.nan,
                "cpu_seconds_a_run": each["seconds"],
                "solver": (most - best) / each["steps"],
                "solver_seconds": seconds,
                "refused": each["refused"],
            }


def runs_of(
    world: tm.World, problem: Any, algo: str, seeds: tuple[int, ...], device: str
) -> dict[str, Any]:
    """The AIHTR of each run, CPU seconds and steps of an episode."""
    values, steps, refused, began = [], 1.0, "", time.process_time()
    for seed in seeds:
        try:
            options = {"optimal.enabled": False, "device": device}
            run = tm.train(problem, algo, seed=seed, **options)
        except UserError as error:
            refused = str(error)
            break
        evaluation = tm.evaluate(world, run.policy)
        values.append(evaluation.aihtr)
        steps = evaluation.expected_length
    seconds = (time.process_time() - began) / max(1, len(values))
    return {"values": values, "steps": steps, "seconds": seconds, "refused": refused}


def known(world: tm.World) -> float:
    """The AIHTR of the policy that the solver finds."""
    found = tm.solve(world.but(max_steps=None))  # whole episodes are solved
    return float(tm.evaluate(world, found.policy).aihtr)


class Case(NamedTuple):
    """One kind of world.

    Attributes:
        make: makes a world.
        changes: of its task.
        recorded: whether it is learned from tracks that are recorded in it.
    """

    make: Callable[..., tm.World]
    changes: Mapping[str, Any] = MappingProxyType({})
    recorded: bool = False

    def made(self) -> tuple[tm.World, Any]:
        """The world in which policies are valued, and the problem to learn: the same world, or its tracks."""
        # With other prices, D is their sum unless it is given.
        changes = ({"safe_cost": None} if "cost" in self.changes else {}) | dict(self.changes)
        own = {name: value for name, value in changes.items() if name != "markov"}
        world = self.make()
        problem = _tracks_of(world) if self.recorded else None
        world = world.but(**own)
        return world, world if problem is None else replace(problem, **changes)


def cases(size: int, hidden_size: int) -> dict[str, Case]:
    """Name -> maker of each kind of world."""
    base = partial(tm.make_world, size=size)
    cells = size * size
    price = np.random.default_rng(0).uniform(0.1, 0.3, cells)
    holes = np.where(np.arange(cells) % 5 == 2, np.nan, 0.16)
    p_d = np.random.default_rng(1).uniform(0.7, 1.0, cells)
    plain: dict[str, dict[str, Any]] = {
        "base": {},
        "t_max 0": {"t_max": 0},
        "t_max 2, c .22": {"t_max": 2, "cost": 0.22},
        "window 1": {"window": 1},
        "price per cell": {"cost": price},
        "cells without a sensor": {"cost": holes, "safe_cost": 2.56},
        "free sensors": {"cost": 0.0, "safe_cost": 2.56},
        "max_steps 30": {"max_steps": 30},
        "miss .8": {"detection": 0.8},
        "miss .8, t_max 2": {"detection": 0.8, "t_max": 2},
        "miss .8, p_s .7": {"detection": 0.8, "safe_detection": 0.7},
        "miss per cell": {"detection": p_d},
        "miss .8, window 2": {"detection": 0.8, "window": 2},
        "footprints": footprints(size),
        "footprints, miss .8": footprints(size) | {"detection": 0.8},
        "footprints, window 1": footprints(size) | {"window": 1},
        "memory without modes": {"memory": "displacement"},
    }
    found: dict[str, Case] = {name: Case(base, more) for name, more in plain.items()}
    found["border exit"] = Case(partial(base, border="exit"))
    found["far jumps"] = Case(partial(_jumping, size))
    found["drift .7, c .3"] = Case(partial(base, "drift", persistence=0.7), {"cost": 0.3})
    found["walk, c .4"] = Case(partial(base, "random_walk"), {"cost": 0.4})
    found["3 x 5 cells"] = Case(partial(tm.make_world, size=(3, 5)))
    return found | _hidden(hidden_size)


def _hidden(size: int) -> dict[str, Case]:
    """Targets with modes, and recordings of them."""
    heading = partial(tm.make_world, "heading", size=size)
    told = partial(heading, reveals=True)
    wide = footprints(size)
    holes = {"cost": np.where(np.arange(size**2) == 4, np.nan, 0.16), "safe_cost": 0.16 * size**2}
    regimes = {"regimes": [{"kernel": "random_walk"}, {"kernel": "drift"}], "stay": 0.9}
    found: dict[str, Case] = {}
    memories = ("cell", "displacement", "displacement_gap", "two_displacements")
    for memory in memories:
        found[f"heading, {memory}"] = Case(heading, {"memory": memory})
    remembers = {"memory": "displacement"}
    for name, more in {
        "miss .8": {"detection": 0.8},
        "miss .8, p_s .7": {"detection": 0.8, "safe_detection": 0.7},
        "window 1": {"window": 1},
        "max_steps 30": {"max_steps": 30},
        "t_max 2": {"t_max": 2},
        "footprints": wide,
        "footprints, miss .8": wide | {"detection": 0.8},
        "a cell without a sensor": holes,
    }.items():
        found[f"heading, displacement, {name}"] = Case(heading, remembers | more)
        found[f"heading told, {name}"] = Case(told, more)
    found["heading, cell, miss .8"] = Case(heading, {"detection": 0.8})
    found["heading told"] = Case(told)
    found["regimes, displacement_gap"] = Case(
        partial(tm.make_world, "regimes", size=size, **regimes), {"memory": "displacement_gap"}
    )
    moving = partial(tm.make_world, "constant_velocity", size=size)
    found["constant velocity, displacement"] = Case(moving, remembers)
    found["coordinated turn told"] = Case(
        partial(tm.make_world, "coordinated_turn", size=size, reveals=True)
    )
    for memory in memories:
        found[f"tracks, {memory}"] = Case(heading, {"memory": memory}, recorded=True)
    for name, more in {
        "cell, miss .8": {"detection": 0.8},
        "displacement, miss .8": remembers | {"detection": 0.8},
        "displacement, footprints": remembers | wide,
        "displacement, window 1": remembers | {"window": 1},
        "displacement, max_steps 30": remembers | {"max_steps": 30},
        "displacement, a cell without a sensor": remembers | holes,
    }.items():
        found[f"tracks, {name}"] = Case(heading, more, recorded=True)
    walk = partial(tm.make_world, size=size)
    found["tracks, markov"] = Case(walk, {"markov": True}, recorded=True)
    found["tracks, markov, miss .8"] = Case(walk, {"markov": True, "detection": 0.8}, recorded=True)
    found["tracks, markov, displacement"] = Case(walk, {"markov": True} | remembers, recorded=True)
    return found


def _tracks_of(world: tm.World) -> Any:
    """Tracks that are recorded in a world."""
    with TemporaryDirectory() as folder:
        file = Path(folder) / "tracks.csv"
        write_tracks(file, world, 3_000)
        return tm.load_tracks(file, world.size, t_max=world.t_max, min_length=1)


def write_tracks(file: Path, world: tm.World, count: int) -> None:
    """Write `count` tracks of the target, from any state to its exit, as a .csv file."""
    rng = np.random.default_rng(0)
    kernel, states = world.kernel, world.num_states
    state, name = rng.integers(states, size=count), np.arange(count)
    lines, step = [], 0
    while len(state):
        lines.append(np.column_stack([name, np.full(len(name), step), state // world.modes]))
        sums = np.concatenate([[0.0], np.cumsum(kernel.data)])
        drawn = sums[kernel.indptr[state]] + rng.random(len(state))
        entry = np.searchsorted(sums, drawn, side="right") - 1
        stays = entry < kernel.indptr[state + 1]
        state, name, step = kernel.indices[entry[stays]], name[stays], step + 1
    header = "track,step,cell"
    np.savetxt(file, np.concatenate(lines), fmt="%d", delimiter=",", header=header, comments="")


def footprints(size: int) -> dict[str, Any]:
    """A sensor in every second row and column, which covers the cells up to one away from it; with its price."""
    row, column = np.divmod(np.arange(size * size), size)
    places = [(down, across) for down in range(0, size, 2) for across in range(0, size, 2)]
    near = [np.maximum(abs(row - down), abs(column - across)) <= 1 for down, across in places]
    return {"coverage": np.array(near), "cost": 0.3}


def _jumping(size: int) -> tm.World:
    """A target that mostly stays near, and at times is anywhere."""
    cells = size * size
    near = tm.make_world("random_walk", size=size).kernel.toarray()
    kernel = 0.8 * near + 0.195 / cells
    return tm.World(kernel / kernel.sum(axis=1, keepdims=True) * 0.99, size, cost=0.16, t_max=1)
