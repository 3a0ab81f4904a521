"""Worlds whose beliefs spread, where sets have to change together: what learners lose on them, what can be proved."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, TypeAlias

import numpy as np
import torch

from trackmdp.config import BenchmarkConfig
from trackmdp.policies.table import PolicyTable
from trackmdp.solvers import optimal
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.exchange import best_of, other_starts
from trackmdp.solvers.layers import layer_sets, policy_table, reachable_layers
from trackmdp.training.train import train
from trackmdp.world.make import make_world
from trackmdp.world.model import Array, World

Maker: TypeAlias = Callable[[], Any]
"""Makes a `World`: none of these kernels has modes."""

ALGOS = ("hindsight", "learned_kernel")
STARTS, KICKS, KICKED = 32, 16, 0.05
"""Of the search for the best policy: other starts, and policies of which this share of the sensors is switched."""
PROVED = (
    # What is certified at T_max 2, at T_max 3 and, on grids of 10, 20 and 30, at T_max 5; then what stays open.
    *((name, 10, 2) for name in ("drift .7 c .16", "drift .7 c .22", "drift .7 c .3")),
    *((name, 10, 2) for name in ("walk c .1", "walk c .2", "walk c .3", "walk c .4", "support c .4", "far jumps")),
    ("walk c .3", 10, 3),
    *(("support c .22", size, 5) for size in (10, 20, 30)),
    *(("diagonal c .3", 10, 2), ("20 successors c .08", 10, 2), ("drift .7 c .3", 10, 3)),
)


def worlds(size: int, t_max: int) -> dict[str, Maker]:
    """By name, worlds on `size` x `size` cells."""

    def made(kernel: str, cost: float | list[float], **options: Any) -> Maker:
        return partial(make_world, kernel, size=size, t_max=t_max, cost=cost, **options)

    def table(kernel: Array, cost: float) -> Maker:
        return lambda: World(kernel, size, cost=cost, t_max=t_max)

    cells = size**2
    rng = np.random.default_rng(1)
    any_price = rng.uniform(0.02, 0.5, cells).tolist()
    some_free = np.where(rng.random(cells) < 0.25, 0, 0.25).tolist()
    lognormal = np.minimum(0.2 * np.exp(0.8 * rng.standard_normal(cells)), 2).tolist()
    found: dict[str, Maker] = {}
    for p in (0.5, 0.6, 0.7):
        for c in (0.16, 0.22, 0.3):
            found[f"drift {_text(p)} c {_text(c)}"] = made("drift", c, persistence=p)
    found |= {
        f"paper Z {z} c {_text(c)}": made("random_support", c, support_size=z, seed=seed)
        for z, seed in ((3, 63), (4, 63), (5, 39))  # as in experiment=paper
        for c in (0.16, 0.18, 0.2, 0.22)
    }
    found |= {f"walk c {_text(c)}": made("random_walk", c) for c in (0.1, 0.2, 0.3, 0.4)}
    found |= {f"diagonal c {_text(c)}": made("random_walk", c, diagonal=True) for c in (0.1, 0.2, 0.3)}
    for safe in (0, 1, 1000):
        found[f"D {safe} support c .22"] = made("random_support", 0.22, safe_cost=safe)
        found[f"D {safe} drift .7 c .22"] = made("drift", 0.22, safe_cost=safe)
    return found | {
        "support c .22": made("random_support", 0.22),
        "support c .4": made("random_support", 0.4),
        "Z 9 c .16": made("random_support", 0.16, support_size=9),
        "radius 2 c .16": made("random_support", 0.16, radius=2),
        "Z 9 radius 2 c .1": made("random_support", 0.1, support_size=9, radius=2),
        "exit border, drift .6 c .22": made("drift", 0.22, border="exit", persistence=0.6),
        "exit border, walk c .3": made("random_walk", 0.3, border="exit"),
        "prices .02-.5, drift .7": made("drift", any_price),
        "prices .02-.5, support": made("random_support", any_price),
        "quarter free, walk": made("random_walk", some_free),
        "quarter free, drift .7": made("drift", some_free),
        "lognormal prices, diagonal": made("random_walk", lognormal, diagonal=True),
        "lognormal prices, support": made("random_support", lognormal),
        "far jumps": table(_table(size, 3, reach=1, successors=5, far=3, jumps=0.3), 0.2),
        "rare far jumps": table(_table(size, 4, reach=1, successors=5, far=2, jumps=0.03), 0.2),
        "20 successors c .08": table(_table(size, 5, reach=2, successors=20), 0.08),
        "D 1000 support c .16 exit .001": made("random_support", 0.16, safe_cost=1000, exit_probability=0.001),
        "D 1000 drift .7 c .22 exit .001": made("drift", 0.22, safe_cost=1000, exit_probability=0.001),
    }


def _text(number: float) -> str:
    return f"{number:g}".lstrip("0")


def _table(size: int, seed: int, *, reach: int, successors: int, far: int = 0, jumps: float = 0.0) -> Array:
    """`[M, M]` other cells and probabilities from each cell: some near, and `far` anywhere that have `jumps` of all."""
    rng, kernel = np.random.default_rng(seed), np.zeros((size**2, size**2))
    row, column = np.divmod(np.arange(size**2), size)
    for x in range(size**2):
        near = np.flatnonzero(np.maximum(np.abs(row - row[x]), np.abs(column - column[x])) <= reach)
        chosen = rng.choice(near, min(successors, len(near)), replace=False)
        kernel[x, chosen] += rng.dirichlet(np.full(len(chosen), 2.0)) * (1.0 - jumps)
        if far:
            # Drawn with replacement, so that two jumps may be one.
            kernel[x, rng.integers(0, size**2, far)] += jumps / far
    return kernel * (0.995 / kernel.sum(axis=1, keepdims=True))


def _chosen(cfg: BenchmarkConfig, size: int, t_max: int) -> dict[str, Maker]:
    """Those whose names hold one of `cfg.worlds`; all, where there is none of these."""
    made = worlds(size, t_max)
    return {name: made[name] for name in made if not cfg.worlds or any(word in name for word in cfg.worlds)}


def regret(cfg: BenchmarkConfig, world: World, device: torch.device) -> Iterator[dict[str, Any]]:
    """One row per world and learner, all seeds in it: regret per step to the bound, the bracket included.

    `worst_to_best` is to the best policy that the solver, any of the runs or, where the bracket is open, `STARTS` and
    `KICKS` found. All runs are in this process, so that none pays for the start of Python. The kernel and the prices
    are those of each world, not of the config; grid.size and grid.t_max are.
    """
    for name, make in _chosen(cfg, world.rows, world.t_max).items():
        here = make()
        started = time.process_time()
        best = optimal.solve(here, nodes=cfg.nodes)
        solved = time.process_time() - started
        length, earned, seconds = best.evaluation.expected_length, {}, {}
        for algo in ALGOS:
            started = time.process_time()
            runs = [train(here, algo, seed=seed, optimal={"enabled": False}, device=str(device)) for seed in cfg.seeds]
            earned[algo] = np.array([run.evaluation.aihtr for run in runs])
            seconds[algo] = (time.process_time() - started) / len(runs)
        found = max(best.lower, *(each.max() for each in earned.values()))
        if not best.certified:
            found = max(found, _best_found(here, best.table))
        for algo, each in earned.items():
            yield {
                "world": name,
                "T_max": world.t_max,
                "algo": algo,
                "seeds": len(cfg.seeds),
                "worst": (best.upper - each.min()) / length,
                "mean": (best.upper - each.mean()) / length,
                "worst_to_best": (found - each.min()) / length,
                "bracket": (best.upper - best.lower) / length,
                "cpu_seconds_a_run": seconds[algo],
                "solver_seconds": solved,
            }


def _best_found(world: World, policy: PolicyTable) -> float:
    """AIHTR of the best policy found from many other starts and from `policy` with some sensors switched at random."""
    layers, rng = reachable_layers(world, world.num_choices), np.random.default_rng(0)
    sets = layer_sets(layers, policy)
    kicked = ([on ^ (rng.random(len(on)) < KICKED) for on in sets] for _ in range(KICKS))
    found = best_of(world, layers, sets, itertools.chain(other_starts(world, layers, STARTS), kicked))
    return evaluate(world, policy_table(world, layers, found)).aihtr


def bracket(cfg: BenchmarkConfig, world: World, device: torch.device) -> Iterator[dict[str, Any]]:  # noqa: ARG001
    """One row per world: what is proved of it with `nodes`; the worlds say how large they are and how T_max is."""
    for name, size, t_max in PROVED:
        make = _chosen(cfg, size, t_max).get(name)
        if make is None:
            continue
        started = time.process_time()
        found = optimal.solve(make(), nodes=cfg.nodes)
        yield {
            "world": name,
            "N": size,
            "T_max": t_max,
            "bracket_per_step": (found.upper - found.lower) / found.evaluation.expected_length,
            "nodes": found.nodes,
            "cpu_seconds": time.process_time() - started,
        }
