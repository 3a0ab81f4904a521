"""Frames per second: the environment alone, the collector, and training."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from hydra import compose
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector

from trackmdp.bench.machine import rate
from trackmdp.build import make_algorithm, make_collector
from trackmdp.config import GROUPS, BenchmarkConfig, TrainConfig, from_hydra, to_dict
from trackmdp.policies.actor_critic import make_actor
from trackmdp.policies.fixed import AllOn, RandomSubset
from trackmdp.seeding import generator
from trackmdp.world.env import TrackEnv
from trackmdp.world.model import World

__all__ = ["collector_speed", "env_speed", "train_speed"]

Row = dict[str, Any]


def env_speed(cfg: BenchmarkConfig, world: World, device: torch.device) -> list[Row]:
    """Steps with random subsets drawn inside the loop, resets included, nothing stored."""
    rows = []
    for envs in (1, 64, 1024, 8192):
        env = TrackEnv(world, envs, seed=cfg.seed, max_steps=cfg.grid.max_steps, device=device)
        policy = RandomSubset(world.num_cells, generator(cfg.seed, "benchmark", device=device))
        state = env.reset()

        def step(env: TrackEnv = env, policy: TensorDictModuleBase = policy) -> int:
            nonlocal state
            for _ in range(20):
                _, state = env.step_and_maybe_reset(policy(state))
            return 20 * env.num_envs

        rows.append({"part": "env", "envs": envs, **rate(step, cfg.seconds, device)})
    return rows


def collector_speed(cfg: BenchmarkConfig, world: World, device: torch.device) -> list[Row]:
    """Frames of the collector that training uses, 32 steps a batch, for policies from free to a network."""
    policies: dict[str, TensorDictModuleBase] = {
        "random": RandomSubset(world.num_cells, generator(cfg.seed, "benchmark", device=device)),
        "all_on": AllOn(world.num_cells),
        "actor": make_actor(world.task, 128, 0.0).to(device),
    }
    rows = []
    for name, policy in policies.items():
        for envs in (64, 1024):
            env = TrackEnv(world, envs, seed=cfg.seed, max_steps=cfg.grid.max_steps, device=device)
            collector = Collector(
                env,
                policy,
                frames_per_batch=32 * envs,
                total_frames=-1,
                track_traj_ids=False,
                auto_register_policy_transforms=False,
            )
            batches = iter(collector)

            def batch(batches: Any = batches) -> int:
                return next(batches).numel()

            figures = rate(batch, cfg.seconds, device)
            collector.shutdown()
            rows.append({"part": "collector", "policy": name, "envs": envs, **figures})
    return rows


def train_speed(cfg: BenchmarkConfig, world: World, device: torch.device) -> list[Row]:
    """Frames per second of collecting and learning, for each algorithm as its config stands."""
    rows = []
    for name in GROUPS["algo"]:
        train = train_config([f"algo={name}", f"seed={cfg.seed}", f"threads={cfg.threads}"])
        train.grid, train.kernel, train.cost = cfg.grid, cfg.kernel, cfg.cost
        algorithm = make_algorithm(train, world, device)
        collector = make_collector(train, world, algorithm, device)
        batches = iter(collector)

        def iteration(batches: Any = batches, algorithm: Any = algorithm) -> int:
            batch = next(batches)
            algorithm.step(batch)
            return batch.numel()

        figures = rate(iteration, cfg.seconds, device)
        collector.shutdown()
        rows.append({"part": "train", "algo": name, "settings": to_dict(train.algo), **figures})
    return rows


def train_config(overrides: list[str]) -> TrainConfig:
    """The config that `trackmdp train` would run with these overrides."""
    return from_hydra(compose("train", overrides=overrides), TrainConfig, Path.cwd())
