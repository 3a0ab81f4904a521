"""Frames per second: the environment alone, the collector, training, and logging of episodes."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector

from trackmdp.algos.common import make_algorithm
from trackmdp.app.bench.process import rate
from trackmdp.config import GROUPS, BenchmarkConfig, to_yaml
from trackmdp.config.compose import compose
from trackmdp.episodes.episode import Episode
from trackmdp.episodes.reader import EpisodeReader
from trackmdp.episodes.simulate import simulate
from trackmdp.episodes.writer import EpisodeWriter
from trackmdp.policies.acting import RandomSubset
from trackmdp.policies.nets import make_actor
from trackmdp.policies.policy import Policy, as_policy
from trackmdp.seeding import generator
from trackmdp.solvers import qmdp
from trackmdp.training.collect import make_collector
from trackmdp.world.env import TrackEnv
from trackmdp.world.model import World

_Row = dict[str, Any]
_EPISODES = 100


def env_speed(cfg: BenchmarkConfig, world: World, device: torch.device) -> Iterator[_Row]:
    """Steps with random subsets drawn inside the loop, resets included, nothing stored; `grid.window` as it is set."""
    for envs in cfg.batch_sizes:
        env = TrackEnv(world, envs, seed=cfg.seed, device=device)
        policy = RandomSubset(world.num_sensors, generator(cfg.seed, "benchmark", device=device))
        state = env.reset()

        # Bound as defaults: a closure over the loop's variables would see those of the last round.
        def step(env: TrackEnv = env, policy: TensorDictModuleBase = policy) -> int:
            nonlocal state
            # 20 steps a call, so that reading the clock does not show.
            for _ in range(20):
                _, state = env.step_and_maybe_reset(policy(state))
            return 20 * env.num_envs

        yield {"envs": envs, **rate(step, cfg.seconds, device)}


def collector_speed(cfg: BenchmarkConfig, world: World, device: torch.device) -> Iterator[_Row]:
    """Frames of the collector that training uses, 32 steps a batch, for policies from free to a network."""
    policies: dict[str, TensorDictModuleBase] = {
        "random": RandomSubset(world.num_sensors, generator(cfg.seed, "benchmark", device=device)),
        "all_on": Policy.all_on(world),
        "actor": make_actor(world.task, 128, 0.0).to(device),
    }
    for name, policy in policies.items():
        for envs in (64, 1024):
            env = TrackEnv(world, envs, seed=cfg.seed, device=device)
            collector = Collector(
                env,
                policy,
                frames_per_batch=32 * envs,
                # Without end: how many batches are taken is a question of time.
                total_frames=-1,
                # As in training, whose collector this is to measure: trajectory ids are not used, and cost a part of
                # each step.
                track_traj_ids=False,
                auto_register_policy_transforms=False,
            )
            batches = iter(collector)

            def batch(batches: Any = batches) -> int:
                return next(batches).numel()

            figures = rate(batch, cfg.seconds, device)
            collector.shutdown()
            yield {"policy": name, "envs": envs, **figures}


def train_speed(cfg: BenchmarkConfig, world: World, device: torch.device) -> Iterator[_Row]:
    """Frames per second of collecting and learning, for each algorithm as its config stands.

    Each is run for five times `seconds`, or to its end where that comes first (`whole`): then the updates that follow
    the last frame count as well.
    """
    for name in GROUPS["algo"]:
        train = compose("train", {"algo": name, "seed": cfg.seed, "threads": cfg.threads})
        # Every algorithm in the world of this benchmark, with its own options as shipped.
        train.grid, train.kernel, train.cost = cfg.grid, cfg.kernel, cfg.cost
        algorithm = make_algorithm(train, world, device)
        collector = make_collector(train, world, algorithm.policy, device)
        batches, frames, done = iter(collector), 0, 0
        wall, cpu = time.perf_counter(), time.process_time()
        while done < algorithm.iterations and time.perf_counter() - wall < 5 * cfg.seconds:
            # None once the frames are used up: updates that follow are timed as well, up to `iterations`.
            batch = next(batches, None)
            frames, done = frames + (batch.numel() if batch is not None else 0), done + 1
            algorithm.step(batch)
        spent, used = time.perf_counter() - wall, time.process_time() - cpu
        collector.shutdown()
        figures = {"per_second": frames / spent, "cpu_us_each": 1e6 * used / frames}
        yield {"algo": name, "whole": done == algorithm.iterations, **figures}


def log_speed(cfg: BenchmarkConfig, world: World, device: torch.device) -> Iterator[_Row]:
    """Steps per second of recording, writing, reading and decoding; bytes of a step; belief and policy are in it."""
    policies = {"qmdp": as_policy(world, qmdp.solve(world)), "random_k": Policy.random_k(world, 5)}
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "episodes.mcap"
        for name, policy in policies.items():

            def record(policy: Policy = policy) -> int:
                return sum(map(len, simulate(world, policy, _EPISODES, seed=cfg.seed).complete()))

            # Simulated once, outside of what is timed: "write" is to measure the log alone.
            episodes = list(simulate(world, policy, _EPISODES, seed=cfg.seed).complete())

            def write(policy: Policy = policy, episodes: list[Episode] = episodes) -> int:
                writer = EpisodeWriter.of(file, world, facts={"seed": str(cfg.seed)}, config=to_yaml(cfg))
                writer.add_policy({"label": "benchmark"}, policy)
                for episode in episodes:
                    writer.add(episode)
                writer.finish()
                return sum(map(len, episodes))

            def read() -> int:
                with EpisodeReader(file) as reader:
                    return sum(map(len, reader.episodes()))

            # The file has to be there before it can be measured and read.
            steps = write()
            size = file.stat().st_size / steps
            for what, work in (("record", record), ("write", write), ("read", read)):
                figures = rate(work, cfg.seconds, device)
                yield {"policy": name, "what": what, "bytes_per_step": size, **figures}
